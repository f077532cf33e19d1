"""A CAN log as a table: the same frame loop as in the vehicle, one row per good rate frame."""

import logging
from pathlib import Path

import msgspec
import numpy as np

from rtcomp.errors import RequestError
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import Channel, SignalMap, load_map
from rtcomp.sources.logs import read_log

log = logging.getLogger(__name__)


def read_can_log(
    path: Path, signal_map: str | Path, dbc: str | Path | None = None, channel: str | None = None
) -> dict[str, np.ndarray]:
    """Columns of one channel of a CAN log; `t_s` counts from its first frame.

    Temperatures are held from their frame to the next. Rejected frames are said in a warning.

    Raises:
        RequestError: an unreadable log, a map that does not fit, or a channel that is not named but has to be.
    """
    whole = load_map(signal_map)
    chosen = _choose(whole, channel)
    columns, start_ns = _columns(path, _only(whole, chosen), dbc)
    if chosen.coil_temperature is not None:
        as_housing = msgspec.structs.replace(
            chosen, temperature=chosen.coil_temperature, coil_temperature=None
        )
        coil, _ = _columns(path, _only(whole, as_housing), dbc, quiet=True)
        columns["coil_temp_degC"] = coil["temp_degC"]
    columns["t_s"] = (columns["t_s"] - start_ns) * 1e-9
    return {name: values for name, values in columns.items() if name == "t_s" or np.isfinite(values).any()}


def _choose(signal_map: SignalMap, name: str | None) -> Channel:
    names = [channel.name for channel in signal_map.channels]
    if name is None and len(names) > 1:
        raise RequestError(
            f"map {signal_map.title!r} has channels {', '.join(names)}; choose one with --channel"
        )
    if name is not None and name not in names:
        raise RequestError(f"map {signal_map.title!r} has no channel {name!r}, only {', '.join(names)}")
    return signal_map.channels[names.index(name) if name else 0]


def _only(signal_map: SignalMap, channel: Channel) -> SignalMap:
    return msgspec.structs.replace(signal_map, channels=[channel])


def _columns(
    path: Path, signal_map: SignalMap, dbc: str | Path | None, quiet: bool = False
) -> tuple[dict[str, np.ndarray], int]:
    pipeline = Pipeline(compile_map(signal_map, dbc))
    start_ns, parts = 0, []
    for frames in read_log(path):
        start_ns = start_ns or int(frames["t_ns"][0])
        parts += [samples.corrected.copy() for samples in pipeline.process(frames)]
    if not parts:
        raise RequestError(
            f"{path}: no frame of {signal_map.channels[0].rate.message}; is the map the right one?"
        )
    if pipeline.rejected and not quiet:
        log.warning("%s: frames rejected: %s", path, pipeline.rejected)
    rows = np.concatenate(parts)
    names = {
        "t_s": "t_ns",
        "rate_dps": "rate_raw_dps",
        "temp_degC": "temp_degC",
        "ref_rate_dps": "ref_rate_dps",
    }
    return {
        ours: rows[field].astype(np.int64 if ours == "t_s" else np.float64) for ours, field in names.items()
    }, start_ns
