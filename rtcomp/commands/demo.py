"""`rtcomp demo`: the whole chain on a bundled simulated trace, nothing else needed."""

import contextlib
import json
from typing import Any

import click


@click.command("demo")
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True),
    default=20.0,
    show_default=True,
    help="How long.",
)
@click.option("--model", help="Model file.  [default: the bundled one, from a simulated rate table]")
@click.option(
    "--zenoh", help="zenoh configuration file, or 'local' for this machine only.  [default: in-process]"
)
@click.option("--prefix", default="rtcomp", show_default=True, help="First part of every key.")
@click.option("--view", is_flag=True, help="Show surfaces and streams in the rerun viewer.")
@click.option(
    "--save", type=click.Path(dir_okay=False), help="Keep what the viewer would show in a .rrd file."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document at the end.")
def command(view: bool, save: str | None, as_json: bool, **options: Any) -> None:
    """Replay a simulated drive on a virtual CAN bus, correct it and print the error before and after.

    The trace (90 s in town while the gyro warms from −20 to 15 °C) and the model are simulated and come with
    the package. The samples pass through a real zenoh session.

    \b
    Examples:
        rtcomp demo
        rtcomp demo --seconds 60 --view
    """
    from rtcomp.demo import Demo
    from rtcomp.run import stopping_on_signals
    from rtcomp.summary import show_summary

    demo = Demo(**options, say=lambda text: click.echo(f"rtcomp: {text}", err=True))
    with contextlib.ExitStack() as stack:
        stack.callback(demo.close)
        stack.enter_context(stopping_on_signals(demo.runner))
        if view or save:
            from rtcomp.view.demo import watching

            stack.enter_context(watching(demo.session, options["prefix"], view=view, save=save))
        if not as_json:
            stack.enter_context(live_errors(demo))
        demo.run()
        summary = demo.summary()
    if as_json:
        click.echo(json.dumps(summary))
        return
    show_summary(summary)
    if save:
        click.echo(f"kept in {save}: open it with `rtcomp view {save}`")


@contextlib.contextmanager
def live_errors(demo: Any) -> Any:
    """A line that shows the error falling, while it happens."""
    import threading

    from rich.console import Console
    from rich.live import Live

    console = Console(highlight=False)
    console.print(
        "[bold]rtcomp demo[/]: a simulated drive on a virtual CAN bus, corrected and published on zenoh"
    )
    done = threading.Event()
    with Live(console=console, auto_refresh=False, transient=not console.is_terminal) as live:

        def show() -> None:
            while not done.wait(0.5):
                live.update(_line(demo.tally), refresh=console.is_terminal)

        thread = threading.Thread(target=show, name="live", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


def _line(tally: Any) -> str:
    raw, corrected = tally.recent**0.5
    head = f"  {tally.samples:,} samples received, error rms over the last half second:"
    before = f"  before {raw:7.4f} °/s  [red]{_bar(raw)}[/]"
    after = f"  after  {corrected:7.4f} °/s  [green]{_bar(corrected)}[/]"
    return "\n".join([head, before, after])


def _bar(value: float) -> str:
    return "█" * min(40, round(value * 12)) or "▏"
