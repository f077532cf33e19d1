"""`rtcomp train`: recordings in, a model file out."""

import json
from pathlib import Path

import click

from rtcomp.errors import RequestError


@click.command("train")
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="Model file to write.",
)
@click.option(
    "--method",
    default="gk-rls-refined",
    show_default=True,
    type=click.Choice(["gk-rls-refined", "gk-rls", "physics-informed", "dynamic"]),
    help="gk-rls: the paper's; gk-rls-refined: then refined jointly; physics-informed: open-loop sine, rules on what "
    "it leaves; dynamic: rules and a thermal lag.",
)
@click.option(
    "--rules",
    type=click.IntRange(1, 64),
    help="Number of rules.  [default: by held-out score; 4 for dynamic]",
)
@click.option(
    "--inputs",
    help="Inputs of the rules, by commas: temp_degC, rate_dps, coil_temp_degC, lag_temp_degC, "
    "temp_rate_degC_per_s, time_since_power_on_s.  [default: temp_degC,rate_dps]",
)
@click.option(
    "--lag",
    "lag_s",
    type=click.FloatRange(0, min_open=True),
    help="Time constant [s] of lag_temp_degC and temp_rate_degC_per_s.",
)
@click.option(
    "--no-offset",
    is_flag=True,
    help="φ without the constant of each rule, as the paper prints it (gk-rls only).",
)
@click.option("--rls-start", default=1e6, show_default=True, help="The paper's a in P(0) = a·I.")
@click.option(
    "--fuzziness",
    default=2.0,
    show_default=True,
    type=click.FloatRange(1, min_open=True),
    help="The paper's m.",
)
@click.option(
    "--starts",
    default=3,
    show_default=True,
    type=click.IntRange(1),
    help="Random starts of the clustering; the best objective is kept.",
)
@click.option("--seed", default=0, show_default=True, help="Seed of the starts and of held-out folds.")
@click.option("--static", is_flag=True, help="The true rate is 0 throughout (no ref_rate_dps needed).")
@click.option("--drop-nan", is_flag=True, help="Leave rows out that are not finite numbers, with a warning.")
@click.option("--columns", help="Names in the file: rate_dps=gyro_x_dps,temp_degC=temp_C.")
@click.option("--map", "signal_map", help="Signal map, for CAN logs.")
@click.option("--dbc", help="DBC file, overriding the map's own.")
@click.option("--channel", help="Channel of the map, when it has several.")
@click.option("--sensor", help="Serial number to write into the model; other sensors then refuse it.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document about the model.")
def command(
    recordings: tuple[Path, ...],
    output: Path,
    method: str,
    rules: int | None,
    inputs: str | None,
    lag_s: float | None,
    no_offset: bool,
    rls_start: float,
    fuzziness: float,
    starts: int,
    seed: int,
    static: bool,
    drop_nan: bool,
    columns: str | None,
    signal_map: str | None,
    dbc: str | None,
    channel: str | None,
    sensor: str | None,
    as_json: bool,
) -> None:
    """Train a model on RECORDINGS: tables with rate_dps, temp_degC and ref_rate_dps, or CAN logs with --map.

    \b
    Examples:
        rtcomp simulate rate_table -o table.csv && rtcomp train table.csv -o model.json
        rtcomp train chamber.csv.gz --columns rate_dps=gyro_x_dps,temp_degC=temp_C --static --method dynamic -o x.json
    """
    from rtcomp.model import model_document, save_model
    from training.gk import Settings
    from training.load import load
    from training.shown import Shown
    from training.train import Request, train
    from training.ts import TsOptions

    if no_offset and method != "gk-rls":
        raise RequestError(
            f"--no-offset is the paper's printed form; got --method {method}, give --method gk-rls"
        )
    checked = load(recordings, columns, static, drop_nan, signal_map, dbc, channel)
    request = Request(
        method=method,
        rules=rules,
        inputs=tuple(inputs.split(",")) if inputs else None,
        filters={"lag_temp_degC": lag_s, "temp_rate_degC_per_s": lag_s} if lag_s else None,
        options=TsOptions(
            "gk-rls", 4, not no_offset, rls_start, Settings(fuzziness=fuzziness, starts=starts, seed=seed)
        ),
        sensor=sensor,
    )
    with Shown("clustering") as shown:
        trained = train(
            checked,
            request,
            lambda iteration, change: shown.tick(f"iteration {iteration}, ‖ΔΛ‖ {change:.1e}"),
        )
    save_model(trained.model, output)
    if as_json:
        told = {
            "model": str(output),
            "sha256": model_document(trained.model)["sha256"],
            "notes": trained.sentences,
        }
        click.echo(json.dumps(told | trained.facts))
        return
    for sentence in trained.sentences:
        click.echo(sentence)
    click.echo(f"{output}: {len(trained.model.rules.centers)} rules over {', '.join(trained.model.inputs)}")
