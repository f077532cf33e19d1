"""What a run is asked to do: command-line options or one TOML file, the same names in both."""

from pathlib import Path
from typing import Literal

import msgspec

from rtcomp.errors import RequestError

MAX_BYTES = 1 << 20


class RunConfig(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Settings of `rtcomp run`; paths are relative to the working directory."""

    bus: str | None = None
    log: str | None = None
    map: str = "fog"
    dbc: str | None = None
    model: list[str] = []  # FILE for every channel, or CHANNEL=FILE; several of one channel add up
    trust: list[str] = []  # public keys; given any, only models signed by one of them are taken
    sensor: str | None = None  # serial number of the sensor; a model of another one is refused
    zenoh: str | None = None  # configuration file, or "local"
    prefix: str = "rtcomp"
    encoding: Literal["struct", "json", "cdr"] = "struct"
    keys: dict[str, str] = {}  # channel → key of its rate, in place of <prefix>/<channel>/rate
    record: str | None = None
    state: str | None = None  # checkpoint of the thermal states, taken up again after a restart
    seconds: float | None = None
    power_on: Literal["first-frame", "unknown"] | float = "first-frame"  # or UNIX seconds
    wait_subscriber_s: float | None = None
    allow_swap: bool = False
    realtime: bool = False


def load_config(path: str | Path) -> RunConfig:
    """Read a run's TOML file.

    Raises RequestError naming the file and what is wrong with it.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise RequestError(
                f"{path}: more than {MAX_BYTES} bytes; a run's configuration is a small TOML file"
            )
        return msgspec.toml.decode(content, type=RunConfig)
    except OSError as error:
        raise RequestError(f"cannot read configuration {path}: {error.strerror}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RequestError(f"configuration {path} is not valid: {error}") from error


def override(config: RunConfig, **options: object) -> RunConfig:
    """The configuration with every option that was given on the command line in its place."""
    given = {name: value for name, value in options.items() if value not in (None, (), [], False)}
    merged = msgspec.structs.asdict(config) | given
    try:
        return msgspec.convert(merged, RunConfig)
    except msgspec.ValidationError as error:
        raise RequestError(f"{error}; see `rtcomp run --help`") from error
