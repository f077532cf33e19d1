"""Faults of sensor and bus: frames in, flags and counts out, all of it known beforehand."""

from collections.abc import Callable
from typing import Any

import numpy as np

from rtcomp import fog_format
from rtcomp.frames import CAN_ERR_CRTL, CAN_ERR_CRTL_RX_OVERFLOW, FRAME, FrameFlag
from tools.faults.trace import (
    RATE_NS,
    RATES,
    SECOND,
    START_NS,
    TEMPERATURES,
    Scenario,
    Trace,
    compiled_strict_map,
    counted,
    error_frame,
    make_model,
    make_trace,
)

UNSETTLED = 500
HEALTHY: dict[str, Any] = {
    "samples": RATES,
    "rejected": {},
    "flags": {"unsettled": UNSETTLED},
    "ignored": 0,
    "lost_frames": 0,
    "clock_steps": 0,
    "temperatures": TEMPERATURES,
    "honest": True,
    "undeclared": 0,
}
FIVE = [700, 900, 1100, 1500, 1900]  # rows far apart, all settled
Make = Callable[[Trace], np.ndarray]
STREAMS: list[tuple[str, dict[str, Any], Make]] = []


def fault(name: str, flags: dict[str, int] | None = None, **expected: Any) -> Callable[[Make], Make]:
    """Register a fault: flags beside those of a healthy run, and counts that differ from it."""

    def register(make: Make) -> Make:
        document = HEALTHY | expected | {"flags": HEALTHY["flags"] | (flags or {})}
        document["flags"] = {flag: n for flag, n in document["flags"].items() if n}
        STREAMS.append((name, document, make))
        return make

    return register


def scenarios() -> list[Scenario]:
    """Every fault of this module."""
    return [Scenario(name, _runner(expected, make)) for name, expected, make in STREAMS]


def _runner(expected: dict[str, Any], make: Make) -> Callable[[Any], tuple[dict[str, Any], dict[str, Any]]]:
    return lambda _: (expected, counted(compiled_strict_map(), make(make_trace()), [make_model()]))


@fault("healthy")
def _healthy(trace: Trace) -> np.ndarray:
    return trace.frames()


@fault("temperature missing", {"temperature_missing": RATES, "unsettled": 0}, temperatures=0)
def _temperature_missing(trace: Trace) -> np.ndarray:
    return trace.rates()


@fault("temperature stale", {"temperature_stale": 799}, temperatures=101)  # the last at 10 s, 2 s allowed
def _temperature_stale(trace: Trace) -> np.ndarray:
    return trace.frames(temperatures=trace.temperatures()[:101])


@fault("temperature NaN-coded", {"temperature_stale": 799})
def _temperature_coded(trace: Trace) -> np.ndarray:
    shown = np.where(np.arange(TEMPERATURES) > 100, np.nan, trace.temp_degC)
    return trace.frames(temperatures=trace.temperatures(shown))


@fault("temperature stuck", {"temperature_stuck": 990})  # since 5 s, known with the one of 10.1 s
def _temperature_stuck(trace: Trace) -> np.ndarray:
    return trace.frames(temperatures=trace.temperatures(np.minimum(trace.temp_degC, trace.temp_degC[50])))


@fault("temperature jumping once", {"temperature_implausible": 10}, rejected={"implausible": 2})
def _temperature_jump(trace: Trace) -> np.ndarray:
    shown = trace.temp_degC.copy()
    shown[100] += 40.0
    return trace.frames(temperatures=trace.temperatures(shown))


# 8.05 K at 2 K/s while it rises by 0.05 K/s itself: believed 4.2 s after the last good one of 9.9 s
@fault(
    "temperature jumping for good",
    {"temperature_implausible": 410, "temperature_stale": 219, "unsettled": 2 * UNSETTLED},
    rejected={"implausible": 82},
)
def _temperature_step(trace: Trace) -> np.ndarray:
    shown = trace.temp_degC + np.where(np.arange(TEMPERATURES) >= 100, 8.05, 0.0)
    return trace.frames(temperatures=trace.temperatures(shown))


@fault("temperature out of the model's range", {"extrapolating": RATES})
def _temperature_hot(trace: Trace) -> np.ndarray:
    return trace.frames(temperatures=trace.temperatures(trace.temp_degC + 60.0))


def _rates(trace: Trace, rows: Any, values: Any) -> np.ndarray:
    rates = trace.rate_dps.copy()
    rates[rows] = values
    return trace.frames(rates=fog_format.encode_rate(trace.rate_t_ns, rates))


# a whole period of 4 s; half a second is allowed, in which nobody can tell
@fault("rate stuck", {"rate_stuck": 349}, undeclared=50)
def _rate_stuck(trace: Trace) -> np.ndarray:
    return _rates(trace, slice(1000, 1400), trace.rate_dps[1000])


@fault("rate spiking", {"rate_implausible": 5})
def _rate_spikes(trace: Trace) -> np.ndarray:
    return _rates(trace, FIVE, 150.0)


@fault("rate a sentinel", {"rate_implausible": 5, "saturated": 5, "extrapolating": 5})
def _rate_sentinel(trace: Trace) -> np.ndarray:
    return _rates(trace, FIVE, -2147.483648)


@fault("rate saturated", {"rate_implausible": 10, "saturated": 10, "extrapolating": 10})
def _rate_saturated(trace: Trace) -> np.ndarray:
    return _rates(trace, slice(1000, 1010), 400.0)


@fault("sensor reports a fault", {"sensor_fault": 10})
def _status(trace: Trace) -> np.ndarray:
    status = np.where(np.arange(RATES) // 10 == 100, 2, 0)
    return trace.frames(rates=fog_format.encode_rate(trace.rate_t_ns, trace.rate_dps, status=status))


def _damaged(trace: Trace, field: str, value: int) -> np.ndarray:
    rates = trace.rates()
    rates[field][FIVE] = value
    return trace.frames(rates=rates)


@fault("CRC of rates wrong", {"bad_frame_before": 5}, samples=1995, rejected={"crc": 5})
def _crc(trace: Trace) -> np.ndarray:
    rates = trace.rates()
    rates["data"][FIVE, 4] ^= 1
    return trace.frames(rates=rates)


@fault("CRC of temperatures wrong", {"bad_frame_before": 4}, temperatures=196, rejected={"crc": 4})
def _crc_temperature(trace: Trace) -> np.ndarray:
    temperatures = trace.temperatures()
    temperatures["data"][[20, 60, 100, 140], 2] ^= 0x80
    return trace.frames(temperatures=temperatures)


BAD_KIND = {"bad_frame_before": 5}  # their counters were not seen, so each costs the next frame as well
MISSED = {"samples": 1990}


@fault("length wrong", BAD_KIND, **MISSED, rejected={"length": 5, "counter_jump": 5})
def _length(trace: Trace) -> np.ndarray:
    return _damaged(trace, "length", 7)


@fault("remote frames", BAD_KIND, **MISSED, rejected={"remote_frame": 5, "counter_jump": 5})
def _remote(trace: Trace) -> np.ndarray:
    return _damaged(trace, "flags", FrameFlag.REMOTE)


@fault("extended ids of the same number", BAD_KIND, **MISSED, rejected={"id_kind": 5, "counter_jump": 5})
def _extended(trace: Trace) -> np.ndarray:
    return _damaged(trace, "flags", FrameFlag.EXTENDED)


@fault(
    "counter frozen",
    {"bad_frame_before": 1, "gap_before": 1},
    samples=1899,
    rejected={"counter_repeat": 100, "counter_jump": 1},
)
def _counter_frozen(trace: Trace) -> np.ndarray:
    rates = trace.rates()
    for k in range(1000, 1100):
        rates[k : k + 1] = fog_format.encode_rate(
            trace.rate_t_ns[k : k + 1], trace.rate_dps[k : k + 1], counter=999
        )
    return trace.frames(rates=rates)


@fault("every frame of half a second sent twice", {"bad_frame_before": 50}, rejected={"counter_repeat": 50})
def _duplicated(trace: Trace) -> np.ndarray:
    rows = np.sort(np.concatenate([np.arange(RATES), np.arange(1000, 1050)]))
    return trace.frames(rates=trace.rates()[rows])


@fault(
    "two frames re-ordered",
    {"bad_frame_before": 1, "gap_before": 1},
    samples=1997,
    rejected={"counter_jump": 3},
)
def _reordered(trace: Trace) -> np.ndarray:
    rates = trace.rates()
    rates["data"][[1000, 1001]] = rates["data"][[1001, 1000]]
    return trace.frames(rates=rates)


@fault("a burst lost", {"bad_frame_before": 1, "gap_before": 1}, samples=1899, rejected={"counter_jump": 1})
def _burst(trace: Trace) -> np.ndarray:
    return trace.frames(rates=np.delete(trace.rates(), np.arange(1000, 1100)))


@fault("a burst lost that the counter cannot see", {"gap_before": 1}, samples=1985)
def _unseen_burst(trace: Trace) -> np.ndarray:
    return trace.frames(rates=np.delete(trace.rates(), np.arange(1000, 1015)))


def _with_event(trace: Trace, *events: np.ndarray) -> np.ndarray:
    return fog_format.merge(trace.frames(), *events)


@fault("the receiver's buffer overflowed", {"frames_lost": 1}, lost_frames=300)
def _overflow(trace: Trace) -> np.ndarray:
    data = bytes([0, CAN_ERR_CRTL_RX_OVERFLOW]) + (300).to_bytes(4, "little")
    return _with_event(trace, error_frame(START_NS + 10 * SECOND + 1, CAN_ERR_CRTL, data))


@fault("bus error frames", {"bad_frame_before": 20}, rejected={"error_frame": 20})
def _errors(trace: Trace) -> np.ndarray:
    return _with_event(trace, *(error_frame(START_NS + k * SECOND // 2 + 1) for k in range(20)))


@fault("the host's clock stepped", {"clock_step": 1}, clock_steps=1)
def _clock_step(trace: Trace) -> np.ndarray:
    return _with_event(trace, error_frame(START_NS + 10 * SECOND + 1, 0))


@fault("time going backwards by an hour", {"clock_step": 1, "unsettled": 2 * UNSETTLED})
def _backwards(trace: Trace) -> np.ndarray:
    return _shifted(trace, -3600)


@fault("a gap of two hours", {"gap_before": 1, "unsettled": 2 * UNSETTLED})
def _gap(trace: Trace) -> np.ndarray:
    return _shifted(trace, 7200)


def _shifted(trace: Trace, seconds: int) -> np.ndarray:
    frames = trace.frames()
    late = frames["t_ns"] >= START_NS + 10 * SECOND
    frames["t_ns"][late] += seconds * SECOND
    return frames


@fault("foreign ids in between", ignored=3000)
def _foreign(trace: Trace) -> np.ndarray:
    foreign = np.zeros(3000, FRAME)
    random = np.random.default_rng(8)
    foreign["t_ns"] = START_NS + random.integers(0, 20 * SECOND, 3000)
    foreign["can_id"] = random.integers(0x100, 0x7FF, 3000)
    foreign["length"] = 8
    foreign["data"][:, :8] = random.integers(0, 256, (3000, 8))
    return fog_format.merge(trace.frames(), foreign)


@fault("a flood of garbage on the rate's id", {"bad_frame_before": 1}, rejected={"length": 100_000})
def _flood(trace: Trace) -> np.ndarray:
    random = np.random.default_rng(9)
    garbage = np.zeros(100_000, FRAME)
    garbage["t_ns"] = START_NS + 10 * SECOND + np.sort(random.integers(1, RATE_NS, len(garbage)))
    garbage["can_id"] = fog_format.RATE_ID
    garbage["length"] = random.integers(0, 8, len(garbage))
    garbage["data"] = random.integers(0, 256, (len(garbage), 64))
    return fog_format.merge(trace.frames(), garbage)
