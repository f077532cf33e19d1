"""Coverage-guided fuzzing of every door with atheris: `python -m tools.fuzz [TARGET…] --seconds 60 --json`.

Each target runs in a process of its own, for libFuzzer ends the one it runs in. Findings are written to a folder, and
each becomes a regression test in `tests/test_fuzz.py` when it is mended. Kernels run compiled: their coverage is not
seen, what comes of them is.
"""

import json
import re
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from tools.fuzz_seeds import seeds
from tools.fuzz_targets import TARGETS

MAX_BYTES = 4096
START_S = 1800  # a child compiles first, perhaps on a machine with better things to do


def fuzz_one(name: str, seconds: int, folder: Path) -> dict[str, Any]:
    """Fuzz one target; executions, coverage and what was found."""
    corpus, found = folder / f"{name}-corpus", folder / f"{name}-found"
    corpus.mkdir(parents=True, exist_ok=True)
    found.mkdir(exist_ok=True)
    for k, seed in enumerate(seeds(name)):
        (corpus / f"seed{k}").write_bytes(seed)
    longest = max(MAX_BYTES, *(2 * len(seed) for seed in seeds(name)))
    command = [
        sys.executable, "-m", "tools.fuzz_child", name, str(corpus),
        f"-max_total_time={seconds}", f"-artifact_prefix={found}/", f"-max_len={longest}",
        "-rss_limit_mb=4096", "-timeout=60", "-report_slow_units=60", "-print_final_stats=1", "-verbosity=1",
    ]  # fmt: skip
    said = folder / f"{name}-said.txt"
    with said.open("w") as file:
        status = _ended(subprocess.Popen(command, stdout=file, stderr=file), seconds + START_S)
    text = said.read_text(errors="replace")
    executions = re.search(r"number_of_executed_units: (\d+)", text)
    coverage = re.findall(r"cov: (\d+)", text)
    reason = re.findall(r"=== Uncaught Python exception: ===\n(.*)", text)
    return {
        "target": name,
        "executions": int(executions.group(1)) if executions else 0,
        "coverage": int(coverage[-1]) if coverage else 0,
        "seconds": seconds,
        "findings": [
            {"reason": (reason or ["?"])[0], "input": path.read_bytes().hex()} for path in found.iterdir()
        ],
        "ended": status,
    }


def _ended(process: "subprocess.Popen[bytes]", seconds: float) -> int | str:
    """The exit status; one that does not end is killed and an outcome too, not the end of what comes after it."""
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        return f"not by itself in {seconds:.0f} s"
    finally:
        process.kill()
        process.wait()


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("targets", nargs=-1)
@click.option("--seconds", default=60, show_default=True, help="For each target.")
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of corpus and findings.  [default: a new one]"
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def main(targets: tuple[str, ...], seconds: int, out: Path | None, as_json: bool) -> None:
    """Fuzz some or all targets; exit status 1 when something was found."""
    from rich.console import Console
    from rich.table import Table

    unknown = sorted(set(targets) - set(TARGETS))
    if unknown:
        raise click.UsageError(f"no target {unknown[0]!r}; there are {', '.join(TARGETS)}")
    if find_spec("atheris") is None:
        raise click.UsageError("atheris is not installed; pip install -e '.[fuzz]' brings it")
    folder = out or Path(tempfile.mkdtemp(prefix="rtcomp-fuzz-"))
    results = []
    for name in targets or TARGETS:
        results.append(fuzz_one(name, seconds, folder))
        (folder / "results.json").write_text(json.dumps(results))  # what there is, should it be stopped
    table = Table("target", "executions", "coverage", "findings", title=f"{seconds} s each, in {folder}")
    for result in results:
        reasons = "; ".join(item["reason"] for item in result["findings"]) or (
            "none" if not result["ended"] else f"did not run: ended {result['ended']}"
        )
        table.add_row(result["target"], f"{result['executions']:,}", str(result["coverage"]), reasons)
    Console(stderr=as_json).print(table)
    if as_json:
        click.echo(json.dumps({"targets": results, "folder": str(folder)}))
    sys.exit(any(result["findings"] or result["ended"] for result in results))


if __name__ == "__main__":
    main()
