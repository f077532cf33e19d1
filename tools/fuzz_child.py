"""One target under libFuzzer, in a process that it ends: `python -m tools.fuzz_child TARGET CORPUS -max_total_time=60`.

Imports nothing of the project before atheris has its hooks in. Modules with kernels are left out: what atheris adds
to a function, numba cannot compile.
"""

import logging
import sys
from pathlib import Path

import atheris
from atheris.import_hook import instrument_imports

GUIDED = ["rtcomp", "training", "tools", "can", "cantools", "textparser", "json", "tomllib"]
ROOT = Path(__file__).parents[1]


def modules_with_kernels() -> list[str]:
    """Every module of ours that compiles something."""
    files = [path for package in ("rtcomp", "training") for path in (ROOT / package).rglob("*.py")]
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files if "jit" in path.read_text()
    ]


def main(name: str, arguments: list[str]) -> None:
    """Fuzz until the time is over or something is found."""
    logging.disable(logging.CRITICAL)
    with instrument_imports(include=GUIDED, exclude=modules_with_kernels()):
        from tools.fuzz_seeds import seeds
        from tools.fuzz_targets import run

        for seed in seeds(name):
            run(name, seed)  # loads and compiles what there is, before anybody counts

    def once(data: bytes) -> None:
        run(name, data)

    atheris.Setup([sys.argv[0], *arguments], once)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
