"""The command line: one module per command in `rtcomp.commands`, loaded when it is called."""

import importlib
import logging
import pkgutil
import sys
from typing import Any

import click

import rtcomp
import rtcomp.commands
from rtcomp.errors import RequestError, WorkError, printable


class CommandGroup(click.Group):
    """Finds `rtcomp.commands.NAME.command`; nothing of a command is imported before it is needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Every command there is."""
        return sorted(module.name for module in pkgutil.iter_modules(rtcomp.commands.__path__))

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The click command of that name."""
        if cmd_name not in self.list_commands(ctx):
            return None
        command: click.Command = importlib.import_module(f"rtcomp.commands.{cmd_name}").command
        return command


@click.command(
    cls=CommandGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(rtcomp.__version__, prog_name="rtcomp")
@click.option("-v", "--verbose", is_flag=True, help="Say more on standard error.")
def cli(verbose: bool) -> None:
    """Real-time gyro compensation: CAN frames in, corrected rates out on zenoh.

    \b
    Start with:
        rtcomp demo
        rtcomp run --bus socketcan:can0 --map fog --model model.json
    """
    level = logging.DEBUG if verbose else logging.WARNING
    logging.basicConfig(level=level, stream=sys.stderr, format="rtcomp: %(message)s")
    for noisy in ("can", "numba", "matplotlib", "asammdf"):
        logging.getLogger(noisy).setLevel(logging.ERROR)


def main(arguments: list[str] | None = None) -> Any:
    """Run the command line; exit status 0 done, 1 the work failed, 2 the request was wrong."""
    try:
        return cli.main(args=arguments, prog_name="rtcomp")
    except RequestError as error:
        click.echo(f"rtcomp: {printable(str(error))}", err=True)
        sys.exit(2)
    except WorkError as error:
        click.echo(f"rtcomp: {printable(str(error))}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
