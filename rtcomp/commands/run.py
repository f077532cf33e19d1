"""`rtcomp run`: frames from a bus or a log, corrected rates on zenoh."""

import json
from typing import Any

import click


@click.command("run")
@click.option(
    "--bus",
    help="python-can interface and channel, with its options: socketcan:can0, udp_multicast:239.0.0.1, "
    "pcan:PCAN_USBBUS1?bitrate=500000, …",
)
@click.option(
    "--log",
    help="A CAN log instead of a bus: candump, asc, blf, trc, mf4, csv, gz of each; as fast as it goes.",
)
@click.option("--map", "map", help="Signal map: a bundled name or a TOML file.  [default: fog]")
@click.option("--dbc", help="DBC file, overriding the map's own.")
@click.option(
    "--model",
    multiple=True,
    help="Model FILE for every channel, or CHANNEL=FILE; several add up. Without one, rates pass through, flagged.",
)
@click.option(
    "--trust",
    multiple=True,
    help="Public key (FILE.pub of `rtcomp model --new-key`); only models signed by one of these are taken, swaps too.",
)
@click.option("--sensor", help="Serial number of the sensor; a model of another one is refused.")
@click.option(
    "--zenoh", help="zenoh configuration file, or 'local' for this machine only.  [default: in-process]"
)
@click.option("--prefix", help="First part of every key.  [default: rtcomp]")
@click.option(
    "--encoding", type=click.Choice(["struct", "json", "cdr"]), help="Payload of a sample.  [default: struct]"
)
@click.option("--record", help="Keep the received frames with their ns times: a candump .log or .log.gz.")
@click.option(
    "--state",
    help="Keep the thermal states in this file every 10 s, and take them up again after a restart while fresh.",
)
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="Stop after this long.")
@click.option(
    "--power-on",
    help="When the sensor got power: first-frame, unknown, or UNIX seconds.  [default: first-frame]",
)
@click.option(
    "--wait-subscriber",
    "wait_subscriber_s",
    type=float,
    help="Wait this long for subscribers first.  [default: 2 s for a log on a zenoh network]",
)
@click.option(
    "--config",
    "config_file",
    help="TOML file with these options by their names; the command line goes first.",
)
@click.option(
    "--allow-swap",
    is_flag=True,
    help="Take a new model put to <prefix>/<channel>/model/swap. (SIGHUP reads the model files again in any case.)",
)
@click.option(
    "--realtime",
    is_flag=True,
    help="Ask for real-time priority, locked memory, a CPU and a quiet garbage collector; what is refused is said, "
    "see `rtcomp doctor`.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document at the end.")
def command(
    config_file: str | None,
    as_json: bool,
    power_on: str | None,
    model: tuple[str, ...],
    trust: tuple[str, ...],
    **options: Any,
) -> None:
    """Correct a gyro's rates in real time and publish them on zenoh.

    \b
    Examples:
        rtcomp run --bus socketcan:can0 --map fog --model model.json --zenoh local
        rtcomp run --log drive.log.gz --map css_canmod_gps --json
    """
    from rtcomp.config import RunConfig, load_config, override
    from rtcomp.run import Runner, stopping_on_signals
    from rtcomp.summary import show_summary

    start = load_config(config_file) if config_file else RunConfig()
    config = override(start, model=list(model), trust=list(trust), power_on=_power_on(power_on), **options)
    runner = Runner(config, lambda text: click.echo(f"rtcomp: {text}", err=True))
    with stopping_on_signals(runner):
        runner.start()
        try:
            runner.loop()
        finally:
            runner.close()
    summary = runner.summary()
    if as_json:
        click.echo(json.dumps(summary))
    else:
        show_summary(summary)


def _power_on(text: str | None) -> str | float | None:
    try:
        return float(text) if text is not None else None
    except ValueError:
        return text
