"""What a run did, as a table for a person."""

from typing import Any


def show_summary(summary: dict[str, Any]) -> None:
    """Print a run's summary on standard output."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, value in summary_rows(summary):
        table.add_row(f"[bold]{name}[/]", value)
    Console(highlight=False).print(table)


def summary_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of everything worth saying."""
    seconds = summary["seconds"]
    rows = [
        ("frames", f"{summary['frames']:,} in {seconds:.1f} s ({summary['ignored']:,} of other ids)"),
        ("samples", f"{summary['samples']:,} corrected, {summary['published']:,} published"),
        ("lost", _listed(summary["losses"]) if summary["lost"] else "none"),
        ("rejected", _listed(summary["rejected"]) or "none"),
        ("flags", _listed(summary["flags"]) or "none"),
    ]
    record, state = summary.get("record"), summary.get("state")
    if record:
        stopped = f"; stopped: {record['error']}, {record['lost']:,} not kept" if record["error"] else ""
        rows.append(("recorded", f"{record['frames']:,} frames{stopped}"))
    if state:
        rows.append(("state", _listed(state) or "new"))
    if summary["rms_raw_dps"] is not None:
        ratio = (
            summary["rms_raw_dps"] / summary["rms_corrected_dps"]
            if summary["rms_corrected_dps"]
            else float("inf")
        )
        rms = f"{summary['rms_raw_dps']:.4g} °/s before, {summary['rms_corrected_dps']:.4g} °/s after ({ratio:.1f}×)"
        rows.append(("error rms", rms))
    for stage, percentiles in (summary.get("stages_us") or {}).items():
        if percentiles:
            values = ", ".join(f"{name} {value:.0f}" for name, value in percentiles.items())
            rows.append((f"{stage} µs", values))
    return rows


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count:,}" for name, count in counts.items() if count)
