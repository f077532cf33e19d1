"""The signal map: which signals are a gyro's rate and temperature, and what makes a frame good.

A map is a small TOML file (schema `rtcomp.map/1`); the bundled ones lie beside their DBC files in `can_dbc`.
This module holds data only: names are looked up in the DBC where that is compiled.
"""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from rtcomp.errors import RequestError
from rtcomp.units import rate_unit

ChannelName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.-]+$")]  # it becomes a chunk of a zenoh key
Positive = Annotated[float, Meta(gt=0)]
DEFAULT_DRIFT_DPH = 10.0


class RateSignal(Struct, frozen=True, forbid_unknown_fields=True):
    """A rate of turn, anticlockwise positive after `sign`."""

    message: str
    signal: str
    sign: Literal[1, -1] = 1
    unit: str | None = None  # overrides the DBC's
    not_available: Literal["j1939"] | list[int] = []  # raw values that mean "no value"


class TemperatureSignal(Struct, frozen=True, forbid_unknown_fields=True):
    """A temperature that is held between its frames for at most `max_age_s`; older, it is flagged stale."""

    message: str
    signal: str
    unit: str | None = None  # overrides the DBC's
    max_age_s: Positive = 2.0
    not_available: Literal["j1939"] | list[int] = []
    max_rate_degC_per_s: Positive | None = (
        None  # a quicker change is not believed, and flagged while it lasts
    )
    stuck_after_s: Positive | None = (
        None  # the same raw value for longer is flagged; None: it may stand still
    )


class ValidSignal(Struct, frozen=True, forbid_unknown_fields=True):
    """A status in the rate's own message; a raw value not in `ok` flags the sample as a sensor fault."""

    message: str
    signal: str
    ok: Annotated[list[int], Meta(min_length=1)]


class Channel(Struct, frozen=True, forbid_unknown_fields=True):
    """One stream of corrected rates: one axis of one gyro."""

    name: ChannelName
    rate: RateSignal
    temperature: TemperatureSignal | None = None
    coil_temperature: TemperatureSignal | None = None
    reference: RateSignal | None = None  # for scoring, never for correction
    valid: ValidSignal | None = None
    range_dps: Positive | None = None  # |rate| at or beyond it is flagged as saturated
    period_s: Positive | None = None  # expected between rate frames; None: no gap is ever reported
    max_slope_dps_per_s: Positive | None = None  # a quicker change of the rate is flagged
    stuck_after_s: Positive | None = None  # the very same rate for longer is flagged
    drift_dph: Positive = DEFAULT_DRIFT_DPH  # drift worth correcting; a coarser quantum is warned of

    def __post_init__(self) -> None:
        """A status of another message would judge a sample by a frame of another time."""
        if self.valid is not None and self.valid.message != self.rate.message:
            raise ValueError(
                f"`valid` of channel {self.name} is in message {self.valid.message}, "
                f"wanted a signal of the rate's own message {self.rate.message}"
            )


class E2E(Struct, frozen=True, forbid_unknown_fields=True):
    """End-to-end protection of a payload, see `rtcomp.e2e`."""

    profile: Literal["1A", "5", "toyota"]
    data_id: Annotated[int, Meta(ge=0, le=0xFFFF)] | None = None  # Toyota's sum takes the CAN id instead
    offset: Annotated[int, Meta(ge=0, le=61)] = 0  # of profile 5's header

    def __post_init__(self) -> None:
        """AUTOSAR's profiles are worthless without the sender's number."""
        if (self.data_id is None) != (self.profile == "toyota"):
            need = "takes no" if self.profile == "toyota" else "needs a"
            raise ValueError(f"e2e profile {self.profile} {need} `data_id`")
        if self.offset and self.profile != "5":
            raise ValueError(f"e2e profile {self.profile} takes no `offset`: its header is at byte 0")


class Counter(Struct, frozen=True, forbid_unknown_fields=True):
    """A counter that advances by 1…`max_step` per frame, modulo `modulus`."""

    signal: str
    modulus: Annotated[int, Meta(ge=2)]
    max_step: Annotated[int, Meta(ge=1)] = 1


class MessageRules(Struct, frozen=True, forbid_unknown_fields=True):
    """What a frame of one message must satisfy before it changes anything."""

    name: str
    e2e: E2E | None = None
    counter: Counter | None = None
    match: Literal["id", "pgn"] = "id"  # pgn: J1939; priority and source address of the DBC's id do not count
    source_address: Annotated[int, Meta(ge=0, le=0xFF)] | None = None  # with pgn; None: from anyone

    def __post_init__(self) -> None:
        """A source address without PGN matching would silently be ignored."""
        if self.source_address is not None and self.match != "pgn":
            raise ValueError(f'message {self.name} has a `source_address`, which needs `match = "pgn"`')


class SignalMap(
    Struct, frozen=True, forbid_unknown_fields=True, rename={"channels": "channel", "messages": "message"}
):
    """A whole map. After `load_map`, `dbc` is an absolute path (None where the map names none)."""

    schema: Literal["rtcomp.map/1"]
    title: str
    channels: Annotated[list[Channel], Meta(min_length=1)]
    dbc: str | None = None
    messages: list[MessageRules] = []

    def __post_init__(self) -> None:
        """Names identify streams and rules."""
        for kind, names in (("channel", self.channels), ("message", self.messages)):
            seen = [entry.name for entry in names]
            if len(set(seen)) < len(seen):
                raise ValueError(f"two {kind} entries have one name; got {', '.join(seen)}")


def data_folder() -> Path:
    """The folder of the bundled maps: inside an installed package, or beside it in a source checkout."""
    package = Path(__file__).parent
    installed = package / "can_dbc"
    return installed if installed.is_dir() else package.parent / "can_dbc"


def bundled_maps() -> dict[str, Path]:
    """The maps that come with the project: name → file."""
    return {path.stem: path for path in sorted(data_folder().glob("*.toml"))}


def load_map(name_or_path: str | Path) -> SignalMap:
    """Read a bundled map by its name, or any map by its path; RequestError says what is wrong with it."""
    bundled = bundled_maps()
    path = bundled.get(str(name_or_path)) or Path(name_or_path)
    try:
        signal_map = msgspec.toml.decode(path.read_bytes(), type=SignalMap)
    except (FileNotFoundError, IsADirectoryError):
        raise RequestError(
            f"there is no signal map '{name_or_path}'; wanted a TOML file or one of the bundled maps "
            f"{', '.join(bundled)}"
        ) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RequestError(f"signal map {path} is not valid: {error}") from None
    if signal_map.dbc is None:
        return signal_map
    return msgspec.structs.replace(signal_map, dbc=str((path.parent / signal_map.dbc).resolve()))


def dbc_path(signal_map: SignalMap, override: str | Path | None = None) -> Path:
    """The DBC file to use: `override` (the command line's `--dbc`) before the map's own."""
    chosen = override if override is not None else signal_map.dbc
    if chosen is None:
        raise RequestError(f"signal map '{signal_map.title}' names no DBC file; give one with --dbc FILE")
    path = Path(chosen)
    if not path.is_file():
        raise RequestError(
            f"there is no DBC file {path}; give an existing one with --dbc FILE or in the map's `dbc`"
        )
    return path


def unavailable_from(bits: int) -> int:
    """Lowest raw value of a J1939 signal that is an error (0xFE…) or not available (0xFF…); SAE J1939-71."""
    return 0xFE << (bits - 8) if bits >= 8 else (1 << bits) - 2


def quantum_dph(scale: float, unit: str) -> float:
    """One bit of a rate signal in °/h, from its DBC scale and unit."""
    return abs(scale) * rate_unit(unit, "the rate signal").factor * 3600.0


def quantum_warning(channel: Channel, scale: float, unit: str, drift_dph: float | None = None) -> str | None:
    """A sentence when one bit is coarser than `drift_dph` (None: the channel's own), None when it is not."""
    drift = channel.drift_dph if drift_dph is None else drift_dph
    quantum = quantum_dph(scale, unit)
    if quantum <= drift:
        return None
    return (
        f"channel {channel.name}: one bit of {channel.rate.signal} is {quantum:.3g} °/h, coarser than the "
        f"{drift:.3g} °/h of drift to be corrected; single samples cannot show the correction"
    )
