"""Writer of the FOG frames of `can_dbc/fog.dbc` and `can_dbc/fog_fd.dbc`: arrays in, FRAME arrays out.

Used by the simulator, the demo and the benchmarks; a real sensor's firmware would do the same. Two classical
frames carry rate and temperatures under AUTOSAR E2E profile 1A; one CAN FD frame carries all under profile 5.
A stream that is written in pieces passes `counter` = the number of frames of that kind written before.
"""

import numpy as np
from numpy.typing import ArrayLike

from rtcomp.e2e import profile1a_protect, profile5_protect
from rtcomp.errors import RequestError
from rtcomp.frames import FRAME, FrameFlag
from rtcomp.jit import kernel

# The one place in code for what the bundled DBC files and maps state; tests hold the two together.
RATE_ID, RATE_DATA_ID = 0x0A0, 0x0FA1
TEMPERATURE_ID, TEMPERATURE_DATA_ID = 0x0A1, 0x0FA2
FD_ID, FD_DATA_ID = 0x0A2, 0x0FA3
CLASSICAL_LENGTH, FD_LENGTH = 8, 12
RATE_PER_DPS = 1e6  # counts
TEMPERATURE_PER_K = 100.0  # counts
NOT_AVAILABLE = -32768  # raw temperature
_RATE_LIMIT = 2**31
_COUNTER_MODULUS = 15  # profile 1 counts 0…14


@kernel
def _write_rate(data, first, rate_dps):
    """Little-endian int32 at byte `first` of each row; returns the first row that does not fit, or -1."""
    for i in range(rate_dps.size):
        counts = np.rint(rate_dps[i] * RATE_PER_DPS)
        if not -_RATE_LIMIT <= counts < _RATE_LIMIT:
            return i
        raw = np.int64(counts)
        for k in range(4):
            data[i, first + k] = (raw >> (8 * k)) & 0xFF
    return -1


@kernel
def _write_temperature(data, first, temp_degC):
    """Little-endian int16 at byte `first` of each row (NaN: not available); the first unfit row, or -1."""
    for i in range(temp_degC.size):
        raw = NOT_AVAILABLE
        if not np.isnan(temp_degC[i]):
            counts = np.rint(temp_degC[i] * TEMPERATURE_PER_K)
            if not NOT_AVAILABLE < counts < -NOT_AVAILABLE:
                return i
            raw = np.int64(counts)
        data[i, first] = raw & 0xFF
        data[i, first + 1] = (raw >> 8) & 0xFF
    return -1


@kernel
def _protect_1a(data, length, data_id, counter):
    for i in range(data.shape[0]):
        profile1a_protect(data[i], length, data_id, (counter + i) % _COUNTER_MODULUS)


@kernel
def _protect_5(data, length, data_id, counter):
    for i in range(data.shape[0]):
        profile5_protect(data[i], length, data_id, (counter + i) & 0xFF, 0)


def _empty(t_ns: np.ndarray, can_id: int, length: int, flags: int) -> np.ndarray:
    frames = np.zeros(t_ns.size, FRAME)
    frames["t_ns"] = t_ns
    frames["can_id"] = can_id
    frames["length"] = length
    frames["flags"] = flags
    return frames


def _column(values: ArrayLike, size: int) -> np.ndarray:
    """One float64 per frame, shape `(size,)`."""
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, np.float64), (size,)))


def _refuse(row: int, values: np.ndarray, what: str, limit: str) -> None:
    if row >= 0:
        raise RequestError(
            f"{what} {values[row]} of sample {row} does not fit the FOG frame; wanted {limit}: "
            "correct the recording or its unit"
        )


def _put_rate(data: np.ndarray, first: int, rate_dps: ArrayLike) -> None:
    rates = _column(rate_dps, len(data))
    _refuse(_write_rate(data, first, rates), rates, "rate", "a finite number within ±2147.48 °/s")


def _put_temperature(data: np.ndarray, first: int, temp_degC: ArrayLike | None) -> None:
    temperatures = _column(np.nan if temp_degC is None else temp_degC, len(data))
    _refuse(_write_temperature(data, first, temperatures), temperatures, "temperature", "±327.67 °C or NaN")


def _nibble(status: ArrayLike) -> np.ndarray:
    values = np.asarray(status)
    unfit = values[(values < 0) | (values > 15)]
    if unfit.size:
        raise RequestError(f"status {unfit.flat[0]} does not fit the FOG frame's 4 bits; wanted 0…15")
    return values.astype(np.uint8)


def encode_rate(
    t_ns: ArrayLike, rate_dps: ArrayLike, *, status: ArrayLike = 0, counter: int = 0
) -> np.ndarray:
    """FOG_RATE frames at `t_ns`, shape `(n,)`; RequestError for a rate beyond 32 bits of 1e-6 °/s."""
    frames = _empty(np.asarray(t_ns, np.int64), RATE_ID, CLASSICAL_LENGTH, 0)
    data = frames["data"]
    data[:, 1] = _nibble(status) << 4
    _put_rate(data, 2, rate_dps)
    _protect_1a(data, CLASSICAL_LENGTH, RATE_DATA_ID, counter)
    return frames


def encode_temperature(
    t_ns: ArrayLike,
    housing_degC: ArrayLike,
    coil_degC: ArrayLike | None = None,
    *,
    status: ArrayLike = 0,
    counter: int = 0,
) -> np.ndarray:
    """FOG_TEMP frames at `t_ns`, shape `(n,)`; NaN (or no coil temperature) is sent as "not available"."""
    frames = _empty(np.asarray(t_ns, np.int64), TEMPERATURE_ID, CLASSICAL_LENGTH, 0)
    data = frames["data"]
    data[:, 1] = _nibble(status) << 4
    _put_temperature(data, 2, housing_degC)
    _put_temperature(data, 4, coil_degC)
    _protect_1a(data, CLASSICAL_LENGTH, TEMPERATURE_DATA_ID, counter)
    return frames


def encode_fd(
    t_ns: ArrayLike,
    rate_dps: ArrayLike,
    housing_degC: ArrayLike | None = None,
    coil_degC: ArrayLike | None = None,
    *,
    status: ArrayLike = 0,
    counter: int = 0,
) -> np.ndarray:
    """FOG_FD frames at `t_ns`, shape `(n,)`: rate and temperatures together, sent with bit rate switching."""
    flags = FrameFlag.FD | FrameFlag.BITRATE_SWITCH
    frames = _empty(np.asarray(t_ns, np.int64), FD_ID, FD_LENGTH, int(flags))
    data = frames["data"]
    data[:, 3] = _nibble(status)
    _put_rate(data, 4, rate_dps)
    _put_temperature(data, 8, housing_degC)
    _put_temperature(data, 10, coil_degC)
    _protect_5(data, FD_LENGTH, FD_DATA_ID, counter)
    return frames


def merge(*streams: np.ndarray) -> np.ndarray:
    """All frames in the order of their times; of equal times the earlier argument's come first."""
    frames = np.concatenate(streams)
    return frames[np.argsort(frames["t_ns"], kind="stable")]
