"""Every named fault over one trace, expected against got: `python -m tools.fault_campaign [--json] [--quick]`."""

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click

from tools.faults import kills, runs, streams
from tools.faults.runs import Context
from tools.faults.trace import Scenario

__all__ = ["kills", "main", "run_scenario", "scenarios"]


def scenarios() -> list[Scenario]:
    """All of them, in the order of the table."""
    return [*streams.scenarios(), *runs.scenarios()]


def run_scenario(scenario: Scenario, quick: bool) -> dict[str, Any]:
    """Name, whether it passed, what was expected and what came; an escaped exception is what came."""
    with tempfile.TemporaryDirectory(prefix="rtcomp-faults-") as folder:
        started = time.monotonic()
        try:
            expected, got = scenario.run(Context(Path(folder), quick))
        except Exception as error:  # noqa: BLE001 - whatever escapes a run is the finding
            expected, got = {"exception": None}, {"exception": repr(error)}
    return {
        "name": scenario.name,
        "passed": expected == got,
        "expected": expected,
        "got": got,
        "seconds": round(time.monotonic() - started, 2),
    }


def difference(result: dict[str, Any]) -> str:
    """What differs, for the table."""
    expected, got = result["expected"], result["got"]
    keys = [key for key in {**expected, **got} if expected.get(key) != got.get(key)]
    return "; ".join(f"{key}: wanted {expected.get(key)}, got {got.get(key)}" for key in keys)


def shown(result: dict[str, Any]) -> str:
    """What came of it, briefly: numbers that a healthy run does not have."""
    if not result["passed"]:
        return difference(result)
    healthy = streams.HEALTHY
    return ", ".join(
        f"{key} {value}"
        for key, value in result["got"].items()
        if key not in healthy or value != healthy[key]
    )


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
@click.option("--quick", is_flag=True, help=f"{kills.QUICK} kills instead of {kills.FULL}.")
@click.option("--only", default="", help="Scenarios whose name contains this.")
def main(as_json: bool, quick: bool, only: str) -> None:
    """Run the campaign; exit status 1 when a scenario fails."""
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    chosen = [scenario for scenario in scenarios() if only in scenario.name]
    aside = Console(stderr=True)
    results = [
        run_scenario(scenario, quick)
        for scenario in track(chosen, "faults", console=aside, disable=not aside.is_terminal)
    ]
    passed = sum(result["passed"] for result in results)
    table = Table("", "scenario", "what came of it", title=f"{passed} of {len(results)} scenarios passed")
    for result in results:
        table.add_row("✓" if result["passed"] else "✗", result["name"], shown(result))
    (aside if as_json else Console()).print(table)
    if as_json:
        click.echo(json.dumps({"scenarios": results, "passed": passed, "of": len(results)}))
    sys.exit(passed < len(results))


if __name__ == "__main__":
    main()
