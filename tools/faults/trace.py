"""The one trace of the fault campaign, and how what came of it is counted.

20 s of a simulated gyro in the project's own frames: 2000 rates at 100 Hz (20 °/s sine of 4 s, noise, seed 7), 200
temperatures at 10 Hz rising by 0.05 K/s. The model is a lag of 1 s on a static surface, so its states are unsettled
for five seconds: 500 samples of a healthy run are flagged, and no other.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import msgspec
import numpy as np

from rtcomp import fog_format
from rtcomp.frames import FRAME, FrameFlag
from rtcomp.model import Model, Polynomial, Term, new_model
from rtcomp.pipeline import Pipeline
from rtcomp.plan import CompiledMap, compile_map
from rtcomp.signal_map import SignalMap, load_map

START_NS = 1_767_225_600_000_000_000
SECOND = 1_000_000_000
RATES, TEMPERATURES = 2000, 200
RATE_NS, TEMPERATURE_NS = SECOND // 100, SECOND // 10
NO_FRAME = ("not_available", "implausible")  # causes that reject a signal of a frame that was good


class Trace(NamedTuple):
    """What the sensor would send, before anything goes wrong."""

    rate_t_ns: np.ndarray
    rate_dps: np.ndarray
    temp_t_ns: np.ndarray
    temp_degC: np.ndarray

    def rates(self) -> np.ndarray:
        """FRAME (2000,)."""
        return fog_format.encode_rate(self.rate_t_ns, self.rate_dps)

    def temperatures(self, temp_degC: np.ndarray | None = None) -> np.ndarray:
        """FRAME (200,)."""
        shown = self.temp_degC if temp_degC is None else temp_degC
        return fog_format.encode_temperature(self.temp_t_ns, shown, shown)

    def frames(self, rates: np.ndarray | None = None, temperatures: np.ndarray | None = None) -> np.ndarray:
        """Both in the order of their times, either of them replaced."""
        return fog_format.merge(
            self.temperatures() if temperatures is None else temperatures,
            self.rates() if rates is None else rates,
        )


def make_trace() -> Trace:
    """The trace; the same every time."""
    t = np.arange(RATES) * 0.01
    rate = 20.0 * np.sin(2 * np.pi * t / 4.0) + np.random.default_rng(7).normal(0.0, 0.02, RATES)
    return Trace(
        START_NS + np.arange(RATES) * RATE_NS,
        rate,
        START_NS + np.arange(TEMPERATURES) * TEMPERATURE_NS,
        20.0 + 0.005 * np.arange(TEMPERATURES),
    )


def strict_map() -> SignalMap:
    """The map `fog` with every limit of plausibility set."""
    fog = load_map("fog")
    document = msgspec.to_builtins(fog)
    (channel,) = document["channel"]
    for name in ("temperature", "coil_temperature"):
        channel[name] |= {"max_rate_degC_per_s": 2.0, "stuck_after_s": 5.0}
    channel |= {"max_slope_dps_per_s": 1000.0, "stuck_after_s": 0.5}
    return msgspec.convert(document, SignalMap)


def compiled_strict_map() -> CompiledMap:
    """The same, compiled."""
    return compile_map(strict_map())


def make_model(**changes: Any) -> Model:
    """A lag of 1 s on a static surface, valid from −40 to 70 °C and within ±200 °/s."""
    fields: dict[str, Any] = {
        "base": Polynomial([[0.05, 1e-3], [0.002]]),
        "terms": [Term("thermal_lag", {"tau_s": 1.0, "bias_dps_per_K": 0.1})],
        "validity": {"temp_degC": (-40.0, 70.0), "rate_dps": (-200.0, 200.0)},
        "residual_std_dps": 0.02,
    }
    return new_model(**(fields | changes))


def error_frame(t_ns: int, can_id: int = 0x40, data: bytes = b"") -> np.ndarray:
    """FRAME (1,): what a controller, or the receiver itself, reports."""
    frame = np.zeros(1, FRAME)
    frame["t_ns"], frame["can_id"], frame["flags"], frame["length"] = t_ns, can_id, FrameFlag.ERROR, 8
    frame["data"][0, : len(data)] = list(data)
    return frame


class Scenario(NamedTuple):
    """A fault by its name: `run` returns what is expected and what came, two documents that must be equal."""

    name: str
    run: Callable[[Any], tuple[dict[str, Any], dict[str, Any]]]


def counted(compiled: CompiledMap, frames: np.ndarray, models: list[Model]) -> dict[str, Any]:
    """Everything the loop counts over `frames`, and whether it adds up."""
    pipeline = Pipeline(compiled, {"yaw": models}, START_NS)
    samples = pipeline.process_all(frames).corrected
    counts = pipeline.counts
    of_frames = sum(n for cause, n in pipeline.rejected.items() if cause not in NO_FRAME)
    return {
        "samples": counts["samples"],
        "rejected": pipeline.rejected,
        "flags": pipeline.flags,
        "ignored": counts["ignored"],
        "lost_frames": counts["lost_frames"],
        "clock_steps": counts["clock_steps"],
        "temperatures": counts["frames"] - counts["samples"] - of_frames - counts["ignored"],
        "honest": is_honest(samples, pipeline.flags),
        "undeclared": undeclared(samples, _healthy_samples()),
    }


@cache
def _healthy_samples() -> np.ndarray:
    pipeline = Pipeline(compiled_strict_map(), {"yaw": [make_model()]}, START_NS)
    return pipeline.process_all(make_trace().frames()).corrected


def undeclared(samples: np.ndarray, healthy: np.ndarray) -> int:
    """Samples off by more than the standard deviation they state, with no flag that a healthy run has not there.

    The same sample is the one of the same time, or, where times were changed, of the same raw rate.
    """
    by_time = {int(t): k for k, t in enumerate(healthy["t_ns"])}
    by_rate = {float(rate): k for k, rate in enumerate(healthy["rate_raw_dps"])}
    pairs = zip(samples["t_ns"].tolist(), samples["rate_raw_dps"].tolist(), strict=True)
    same = healthy[np.array([by_time[t] if t in by_time else by_rate[rate] for t, rate in pairs], np.intp)]
    is_off = np.abs(samples["rate_dps"] - same["rate_dps"]) > samples["sigma_dps"]
    return int(np.count_nonzero(is_off & (samples["flags"] & ~same["flags"] == 0)))


def is_honest(samples: np.ndarray, flags: dict[str, int]) -> bool:
    """No gap in the sequence, nothing but numbers, corrected = raw − correction, flags as counted."""
    bits = {name: int(np.count_nonzero(samples["flags"] >> bit & 1)) for name, bit in _bits().items()}
    return (
        np.array_equal(samples["seq"], np.arange(len(samples)))
        and bool(np.isfinite(samples["rate_dps"]).all())
        and np.array_equal(samples["rate_dps"], samples["rate_raw_dps"] - samples["correction_dps"])
        and {name: n for name, n in bits.items() if n} == flags
    )


def _bits() -> dict[str, int]:
    from rtcomp.frames import schema

    return schema()["flags"]
