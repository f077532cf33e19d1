"""`rtcomp doctor`: what this machine has and lacks."""

import json

import click


@click.command("doctor")
@click.option("--zenoh", help="zenoh configuration whose endpoints are to be tried, or 'local'.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def command(zenoh: str | None, as_json: bool) -> None:
    """Check SocketCAN, vcan, real-time rights, zenoh and the viewer, with the command that mends what is missing.

    \b
    Example:
        rtcomp doctor
    """
    from rtcomp.doctor import check_all, show_checks

    checks = check_all(zenoh)
    if as_json:
        click.echo(json.dumps({"checks": [check._asdict() for check in checks]}))
    else:
        show_checks(checks)
