"""The figures of a trial as tables for a person."""

from typing import Any

from rich.console import Console
from rich.table import Table

Document = dict[str, Any]


def _share(value: Document) -> str:
    if not value["n"]:
        return "no cases"
    return f"{value['rate']:.3f}  ({value['k']}/{value['n']}; {value['low']:.3f} to {value['high']:.3f})"


def _spread(value: Document) -> str:
    if not value["n"]:
        return "no cases"
    span = f"{value['p10']:.3g} .. {value['p90']:.3g}"
    return f"median {value['median']:.3g}, mean {value['mean']:.3g}, 10..90 % {span} (n {value['n']})"


def _text(value: Document) -> str:
    return _share(value) if "rate" in value else _spread(value)


def _is_figure(value: Any) -> bool:
    return isinstance(value, dict) and "n" in value and "wanted" in value


def show(summary: Document, console: Console) -> None:
    """Print figures, confusion matrix, verdicts and limits."""
    figures = Table(
        "figure", "measured (95 % Clopper–Pearson)", "wanted", title=f"blind trial, {summary['cases']} cases"
    )
    for group, entries in summary.items():
        if _is_figure(entries):
            figures.add_row(group, _text(entries), entries["wanted"] or "")
        elif isinstance(entries, dict):
            for name, value in entries.items():
                if _is_figure(value):
                    figures.add_row(f"{group}: {name}", _text(value), value["wanted"] or "")
    console.print(figures)
    _counts(summary["confusion"], "truth", "first name reported", console)
    _counts(summary["verdicts"], "level", "verdicts", console)
    _by_name(summary["parameters"]["by_parameter"], "parameter", "relative error", console)
    _by_name(summary["limits_dph"]["said_visible_from"], "effect", "said visible from, °/h rms", console)
    for case in summary["not_done"]:
        console.print("not done:", *case)
    for alarm in summary["null"]["alarms"]:
        console.print("false alarm:", *alarm)


def _counts(rows: Document, first: str, second: str, console: Console) -> None:
    table = Table(first, second)
    for name, counts in rows.items():
        table.add_row(
            name, ", ".join(f"{key} {count}" for key, count in sorted(counts.items(), key=lambda c: -c[1]))
        )
    console.print(table)


def _by_name(rows: Document, first: str, second: str, console: Console) -> None:
    if not rows:
        return
    table = Table(first, second)
    for name, value in rows.items():
        table.add_row(name, _spread(value))
    console.print(table)


def show_extras(title: str, document: Document, console: Console) -> None:
    """Print a flat document of controls or peers."""
    table = Table("what", "measured", title=title)
    for name, value in document.items():
        if _is_figure(value):
            table.add_row(name, _text(value))
        elif isinstance(value, dict):
            for key, inner in value.items():
                table.add_row(f"{name}: {key}", _text(inner) if _is_figure(inner) else str(inner))
        else:
            table.add_row(name, str(value))
    console.print(table)
