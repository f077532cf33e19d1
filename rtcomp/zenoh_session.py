"""zenoh sessions: the user's configuration passes through untouched; without one nothing leaves the process."""

from pathlib import Path
from typing import Any

from rtcomp.errors import RequestError, WorkError

LOCAL_ENDPOINT = "tcp/127.0.0.1:7447"
LOCAL = "local"
"""`--zenoh local`: publisher and viewer of one machine meet on the loopback interface."""


def open_session(config: str | Path | None, listen: bool = True) -> Any:
    """Open a session.

    Args:
        config: a zenoh configuration file (JSON5 or YAML), `local`, or None for an in-process peer without scouting.
        listen: with `local`, whether this side waits for the other (the publisher) or connects to it.

    Raises:
        RequestError: the configuration cannot be read or is refused by zenoh.
        WorkError: zenoh cannot open the session it describes.
    """
    import zenoh

    zenoh.init_log_from_env_or("error")
    if config is None or str(config) == LOCAL:
        settings = _local_config(None if config is None else LOCAL_ENDPOINT, listen)
    else:
        settings = _read_config(Path(config))
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        raise WorkError(
            f"zenoh cannot open the session of {config or 'the default configuration'}: {error}"
        ) from error


def _local_config(endpoint: str | None, listen: bool) -> Any:
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"peer"' if listen else '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(
        "transport/link/tx/queue/size/data", "16"
    )  # batches; two are lost on at the first hiccup
    config.insert_json5("listen/endpoints", f'["{endpoint}"]' if endpoint and listen else "[]")
    if endpoint and not listen:
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    return config


def _read_config(path: Path) -> Any:
    import zenoh

    if not path.is_file():
        raise RequestError(
            f"no zenoh configuration {path}; give a file, or `--zenoh {LOCAL}` for this machine only"
        )
    try:
        return zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise RequestError(f"zenoh refuses the configuration {path}: {error}") from error
