"""`rtcomp evaluate`: models and baselines scored on recordings."""

import json
import sys
from pathlib import Path
from typing import Any

import click


@click.command("evaluate")
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--baselines/--no-baselines", default=True, show_default=True, help="Score every baseline, too."
)
@click.option(
    "--baselines-from",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Train the baselines on these recordings instead of cross-fitting.",
)
@click.option("--static", is_flag=True, help="The true rate is 0 throughout (no ref_rate_dps needed).")
@click.option("--drop-nan", is_flag=True, help="Leave rows out that are not finite numbers, with a warning.")
@click.option("--columns", help="Names in the file: rate_dps=gyro_x_dps,temp_degC=temp_C.")
@click.option("--map", "signal_map", help="Signal map, for CAN logs.")
@click.option("--dbc", help="DBC file, overriding the map's own.")
@click.option("--channel", help="Channel of the map, when it has several.")
@click.option(
    "--power-on",
    type=click.Choice(["first-row", "unknown"]),
    default="first-row",
    show_default=True,
    help="Whether t_s counts from power-on.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def command(
    files: tuple[Path, ...],
    baselines: bool,
    baselines_from: tuple[Path, ...],
    static: bool,
    drop_nan: bool,
    columns: str | None,
    signal_map: str | None,
    dbc: str | None,
    channel: str | None,
    power_on: str,
    as_json: bool,
) -> None:
    """Score models (FILES ending in .json) on recordings (all other FILES), beside every baseline.

    Largest error, standard deviation, RMS with an interval clustered by soak, recording or block, per-temperature
    and per-rate tables, coverage of the stated uncertainty, and Allan deviation at rest.

    \b
    Example:
        rtcomp evaluate model.json drive1.csv.gz drive2.csv.gz
    """
    from rtcomp.model import load_model
    from training.evaluate import evaluate
    from training.load import load
    from training.shown import Shown

    models = {path.stem: load_model(path) for path in files if path.suffix == ".json"}
    reading: dict[str, Any] = {
        "columns": columns, "static": static, "drop_nan": drop_nan,
        "signal_map": signal_map, "dbc": dbc, "channel": channel,
    }  # fmt: skip
    recordings = load(_recordings(files), **reading)
    trained_on = load(baselines_from, **reading)
    with Shown("scoring") as shown:
        told = evaluate(models, recordings, baselines, trained_on, power_on == "first-row", shown.tick)
    if as_json:
        click.echo(json.dumps(told))
    else:
        _show(told)


def _recordings(files: tuple[Path, ...]) -> list[Path]:
    from rtcomp.errors import RequestError

    recordings = [path for path in files if path.suffix != ".json"]
    if not recordings:
        raise RequestError(
            f"got {len(files)} models and no recording; give at least one recording to score them on"
        )
    return recordings


def _show(told: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(
        width=None if sys.stdout.isatty() else 150, markup=False, highlight=False, soft_wrap=True
    )
    table = Table("method", "max °/s", "std °/s", "RMS °/s", "95 % of RMS", "times better")
    for row in sorted(told["rows"], key=lambda row: row["rms_dps"]):
        interval = "{:.4g} … {:.4g}".format(*row["rms_ci95"]) if row["rms_ci95"] else "-"
        name = row["method"] + (" (in-sample)" if row["in_sample"] else "")
        figures = [f"{row[key]:.4g}" for key in ("max_dps", "std_dps", "rms_dps")]
        table.add_row(name, *figures, interval, f"{row['improvement']:.3g}")
    console.print(table)
    groups = told["groups"]
    console.print(f"{groups['count']} {groups['what']}s; intervals clustered by {groups['what']}")
    console.print(f"baselines: {told['baselines']}")
    for name, share in told["coverage"].items():
        if share is not None:
            console.print(f"{name}: {share:.1%} of errors within its stated 95 % interval")
    for column, unit in (("temp_degC", "°C"), ("rate_dps", "°/s")):
        console.print(_bins(told["per_temperature" if column == "temp_degC" else "per_rate"], column, unit))
    for entry in told["allan"]:
        for name, curve in entry["methods"].items():
            best = curve["bias_instability_dps"]
            console.print(
                f"{entry['recording']}, {entry['seconds']:.0f} s at rest, {name}: bias instability {best:.3g} °/s"
            )


def _bins(rows: list[dict[str, Any]], column: str, unit: str) -> Any:
    from rich.table import Table

    names = list(rows[0]["methods"])
    table = Table(f"{column} [{unit}]", "samples", *[f"{name}: RMS / max °/s" for name in names])
    for row in rows:
        cells = ["{rms_dps:.4g} / {max_dps:.4g}".format(**row["methods"][name]) for name in names]
        table.add_row(f"{row[column]:g}", str(row["samples"]), *cells)
    return table
