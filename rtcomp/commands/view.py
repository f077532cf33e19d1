"""`rtcomp view`: surfaces and streams in rerun, live from zenoh or from files."""

import json
import re
from typing import Any

import click

MEMORY = re.compile(r"\d+(\.\d+)?(B|[kMGT]B|[KMGT]iB|%)")  # what rerun reads; it asks only once it is started


def _memory(_context: click.Context, _parameter: click.Parameter, value: str) -> str:
    if not MEMORY.fullmatch(value):
        raise click.BadParameter(f"{value!r} is no size; write 256MiB, 1GB or 25% (of the machine's memory)")
    return value


@click.command("view")
@click.argument("files", nargs=-1, type=click.Path(exists=True))
@click.option("--web", is_flag=True, help="Serve rerun's web viewer instead of opening a window.")
@click.option("--save", type=click.Path(dir_okay=False), help="Write FILE.rrd (no window unless --web).")
@click.option("--zenoh", help="zenoh configuration file, or 'local' for this machine.  [default: local]")
@click.option("--prefix", default="rtcomp", show_default=True, help="First part of every key.")
@click.option(
    "--memory-limit",
    default="256MiB",
    callback=_memory,
    show_default=True,
    help="Data that rerun may hold, the oldest go first; its process takes about twice that.",
)
@click.option(
    "--bind", default="127.0.0.1", show_default=True, help="Address on which viewer and web server listen."
)
@click.option(
    "--port",
    default=9090,
    show_default=True,
    type=click.IntRange(0, 65535),
    help="Port of the web page; any free one when it is taken.",
)
@click.option(
    "--window",
    "window_s",
    default=30.0,
    show_default=True,
    type=click.FloatRange(min=1),
    help="Seconds of the past in the plots.",
)
@click.option(
    "--wait",
    "wait_s",
    default=30.0,
    show_default=True,
    type=click.FloatRange(min=0),
    help="Seconds to wait for a stream.",
)
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="Stop after this long.")
@click.option("--map", "signal_map", help="Signal map, where a FILE is a CAN log.")
@click.option("--channel", help="Channel of that map, where it has several.")
@click.option(
    "--paper",
    type=click.IntRange(min=0),
    metavar="SEED",
    help="Show a run of the paper's simulated experiment.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document at the end.")
def command(as_json: bool, **options: Any) -> None:
    """Show error surfaces and streams in the rerun viewer.

    Without FILES: live, whatever `rtcomp run --zenoh local` publishes on this machine. FILES may be models,
    recordings (shown before and after the models among the FILES), a folder of `rtcomp diagnose`, or .rrd files.

    \b
    Examples:
        rtcomp view
        rtcomp view --web
        rtcomp view --save drive.rrd --seconds 60
        rtcomp view model.json drive.csv.gz
    """
    from rtcomp.view.run import ViewConfig, be_modest, run_view

    be_modest()
    report = run_view(ViewConfig(**options), lambda text: click.echo(f"rtcomp: {text}", err=True))
    if as_json:
        click.echo(json.dumps(report))
