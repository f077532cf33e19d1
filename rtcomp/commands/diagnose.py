"""`rtcomp diagnose`: what physics a simulation leaves out, from recordings."""

import logging
from pathlib import Path

import click

FILE = click.Path(path_type=Path, dir_okay=False)


class _Command(click.Command):
    """Lets `--heldout` take several files at once, up to the next option, as `--heldout A B`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Write `--heldout A B` as `--heldout A --heldout B`, unless that would leave no recording to learn from."""
        spread: list[str] = []
        taking = False
        for word in list(args):
            if word.startswith("-"):
                taking = word == "--heldout"
            elif taking and spread[-1] != "--heldout":
                spread.append("--heldout")
            spread.append(word)
        try:
            return super().parse_args(ctx, spread)
        except click.MissingParameter:
            return super().parse_args(ctx, list(args))


@click.command("diagnose", cls=_Command)
@click.argument("recordings", nargs=-1, required=True, type=FILE)
@click.option(
    "--heldout", multiple=True, type=FILE, help="Recording kept for the proof; may be given several times."
)
@click.option(
    "--simulation",
    type=FILE,
    help="Scenario TOML of the simulator, or a model file; else the column sim_rate_dps, else an ideal gyro.",
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the report and the other files.",
)
@click.option("--static", is_flag=True, help="The unit did not turn: the true rate is zero.")
@click.option(
    "--power-on",
    type=click.Choice(["known", "unknown"]),
    default="known",
    show_default=True,
    help="Whether t_s counts from power-on.",
)
@click.option("--columns", help="Rename columns: rate_dps=gyro_x_dps,temp_degC=temp_C.")
@click.option("--dbc", type=FILE, help="DBC file, for CAN logs.")
@click.option("--map", "signal_map", help="Signal map (name or file), for CAN logs.")
@click.option("--channel", help="Which of the map's channels, when it has several.")
@click.option(
    "--offset-tol",
    type=click.FloatRange(min=0.0),
    default=0.5,
    show_default=True,
    help="Offset [°/s] beyond which it is a finding.",
)
@click.option(
    "--scale-tol",
    type=click.FloatRange(min=0.0),
    default=10_000.0,
    show_default=True,
    help="Scale error [ppm] beyond which it is a finding.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=20_240_501,
    show_default=True,
    help="Seed of the surrogates.",
)
@click.option(
    "--without", multiple=True, help="Leave an effect out of the catalogue (a control of the tool itself)."
)
@click.option("--json", "as_json", is_flag=True, help="Print diagnosis.json on one line.")
def command(
    recordings: tuple[Path, ...],
    heldout: tuple[Path, ...],
    simulation: Path | None,
    out: Path,
    static: bool,
    power_on: str,
    columns: str | None,
    dbc: Path | None,
    signal_map: str | None,
    channel: str | None,
    offset_tol: float,
    scale_tol: float,
    seed: int,
    without: tuple[str, ...],
    as_json: bool,
) -> None:
    """Say what physics is missing where a simulation and RECORDINGS differ, model it, and prove it.

    Needs a truth: ref_rate_dps in the recordings, or --static.

    \b
    Example:
        rtcomp diagnose drive1.csv.gz drive2.csv.gz --heldout drive3.csv.gz --out found
    """
    from training.diagnose.document import probability, to_json
    from training.diagnose.run import run_diagnose
    from training.diagnose.settings import Settings
    from training.table import parse_columns

    settings = Settings(
        static=static,
        power_on_known=power_on == "known",
        offset_tol_dps=offset_tol,
        scale_tol_ppm=scale_tol,
        seed=seed,
        left_out=frozenset(without),
    )
    with _progress() as told:
        found = run_diagnose(
            recordings,
            out,
            heldout,
            simulation,
            settings,
            parse_columns(columns),
            dbc,
            signal_map,
            told,
            channel,
        )
    if as_json:
        click.echo(to_json(found))
        return
    click.echo(found.sentence)
    for finding in found.findings:
        names = " | ".join(finding.alternatives)
        p_value = probability(finding.p_value)
        click.echo(f"  {finding.status:9s} {names}: {finding.rms_dps:.3g} °/s rms, p {p_value}")
    click.echo(f"report: {out / 'report.html'}")


class _progress:  # noqa: N801
    """Shows the stage on a terminal, says it to the log otherwise."""

    def __enter__(self):
        """Start the display."""
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._bar.start()
        self._task = self._bar.add_task("read")
        return self._say

    def __exit__(self, *_: object) -> None:
        """Take the display away."""
        self._bar.stop()

    def _say(self, stage: str) -> None:
        logging.getLogger(__name__).info("%s", stage)
        self._bar.update(self._task, description=stage)
