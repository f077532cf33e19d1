"""`rtcomp simulate`: a scenario in, a simulated recording out."""

import json
from pathlib import Path

import click


def _effects(ctx: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    """Print the catalogue and end."""
    if not wanted or ctx.resilient_parsing:
        return
    from training.effects.catalogue import catalogue

    for entry in catalogue().values():
        click.echo(f"{entry.id}: {entry.title}\n  {entry.equation}")
        for name, what in entry.parameters.items():
            need = "" if what.default is None else f", {what.default:g} when left out"
            click.echo(f"  {name} [{what.unit}]: nominal {what.nominal:.4g}, hard {what.hard:.4g}{need}")
        click.echo(f"  source: {entry.source}")
    ctx.exit()


@click.command("simulate")
@click.argument("scenario")
@click.option(
    "-o",
    "--output",
    "output",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    help="File to write: .csv, .csv.gz or .parquet for a table, .log or .log.gz for a CAN log of FOG frames.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), help="Seed of all random draws; by default the scenario's."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document about the recording.")
@click.option(
    "--effects",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_effects,
    help="List every effect a scenario may switch on: equation, parameters with units, source.",
)
def command(scenario: str, output: Path, seed: int | None, as_json: bool) -> None:
    """Simulate a gyro: SCENARIO (a TOML file, or the name of a bundled one) becomes a recording.

    Bundled: rate_table, chamber_cycle, cold_start_drive, parking, creep, heading_circles, demo_drive,
    paper_omission, soaked_gyro.

    \b
    Examples:
        rtcomp simulate cold_start_drive -o drive.csv.gz --seed 7
        rtcomp simulate --effects
    """
    from training.simulator.run import simulate_file

    told = simulate_file(scenario, output, seed)
    if as_json:
        click.echo(json.dumps(told))
        return
    size = f"{told['rows']} rows" if told["frames"] is None else f"{told['frames']} frames"
    click.echo(f"{told['title']} (simulated, seed {told['seed']})")
    click.echo(f"{told['file']}: {size}, {', '.join(told['columns'])}")
    click.echo(f"error {told['rms_error_dps']:.3g} °/s rms, {told['max_error_dps']:.3g} °/s at most")
