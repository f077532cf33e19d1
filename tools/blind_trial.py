"""Blind trial of `rtcomp diagnose`: python -m tools.blind_trial --cases 40 --seed 1 --jobs 2 --keep DIR."""

import json
import logging
import os
import tempfile
from pathlib import Path

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import click  # noqa: E402  # numerical libraries read the variables above when they load
from rich.console import Console  # noqa: E402
from rich.progress import Progress  # noqa: E402

from rtcomp.errors import RequestError, WorkError  # noqa: E402
from tools.blind.levels import LEVELS  # noqa: E402


def _levels(text: str | None) -> tuple[str, ...]:
    chosen = tuple(part.strip().upper() for part in text.split(",")) if text else LEVELS
    unknown = [level for level in chosen if level not in LEVELS]
    if unknown:
        raise RequestError(f"--levels: got {unknown[0]!r}, wanted some of {', '.join(LEVELS)}")
    return tuple(level for level in LEVELS if level in chosen)


def run_trial(
    cases: int, seed: int, root: Path, levels: tuple[str, ...], jobs: int, controls: int, peers: bool, told
) -> dict[str, object]:
    """Make, seal, run, score; the whole result as one JSON-able document."""
    from tools.blind.summary import summarise
    from tools.blind.trial import run_tool, score_case, seal_cases

    sealed, digest = seal_cases(root, cases, seed, levels, jobs, told)
    names = sorted(sealed["cases"])
    outcomes = run_tool(root, names, jobs, told)
    scores = [score_case(root / name, sealed["cases"][name], outcomes[name]) for name in names]
    result: dict[str, object] = {
        "schema": "rtcomp.blind_trial/1",
        "request": {"cases": cases, "seed": seed, "levels": list(levels)},
        "seals_sha256": digest,
        "summary": summarise(scores),
        "cases": scores,
    }
    if controls:
        from tools.blind.controls import run_controls

        result["controls"] = run_controls(root, scores, sealed["cases"], controls, jobs, seed, told)
    if peers:
        from tools.blind.peers import run_peers

        result["peers"] = run_peers(root, sealed["cases"], jobs, told)
    return result


@click.command()
@click.option(
    "--cases", type=click.IntRange(min=1), required=True, help="How many cases; 500 give 115 nulls."
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    required=True,
    help="Of everything; the same seed makes the same cases.",
)
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Processes.")
@click.option(
    "--keep",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for cases and answers; a trial broken off goes on there.",
)
@click.option("--levels", help="Only these levels, e.g. L0,L1.")
@click.option(
    "--controls",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Runs of each control: label shuffle, time reversal, injection, ablation.",
)
@click.option(
    "--peers",
    is_flag=True,
    help="Give the same cases to pySINDy, lasso, Gaussian process and gradient boosting.",
)
@click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout.")
def main(
    cases: int,
    seed: int,
    jobs: int,
    keep: Path | None,
    levels: str | None,
    controls: int,
    peers: bool,
    as_json: bool,
) -> None:
    """Make sealed cases, let `rtcomp diagnose` answer, score the answers.

    \b
    Example:
        python -m tools.blind_trial --cases 500 --seed 7 --jobs 2 --keep /tmp/trial --controls 8 --peers
    """
    from tools.blind.tables import show, show_extras

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    chosen = _levels(levels)
    with tempfile.TemporaryDirectory() as scratch, _Shown() as told:
        root = keep or Path(scratch)
        root.mkdir(parents=True, exist_ok=True)
        result = run_trial(cases, seed, root, chosen, jobs, controls, peers, told)
        if keep:
            (keep / "result.json").write_text(json.dumps(result))
    if as_json:
        click.echo(json.dumps(result))
        return
    console = Console()
    show(result["summary"], console)  # type: ignore[arg-type]
    for extra in ("controls", "peers"):
        if extra in result:
            show_extras(extra, result[extra], console)  # type: ignore[arg-type]


class _Shown:
    """Progress on stderr when it is a terminal."""

    def __enter__(self):
        console = Console(stderr=True)
        self._bar = Progress(console=console, disable=not console.is_terminal)
        self._bar.start()
        self._tasks: dict[str, int] = {}
        return self._told

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _told(self, stage: str, done: int, total: int) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._bar.add_task(stage.replace("_", " "), total=total)
        self._bar.update(self._tasks[stage], completed=done)  # type: ignore[arg-type]


if __name__ == "__main__":
    try:
        main(standalone_mode=True)
    except (RequestError, WorkError) as error:
        click.echo(f"error: {error}", err=True)
        raise SystemExit(2 if isinstance(error, RequestError) else 1) from error
