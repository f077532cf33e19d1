"""Effects of clocks, buses and gateways: PHYSICS.md D1–D5."""

from types import SimpleNamespace

import numpy as np

from training.effects.base import Columns, FrameEffect, TimingEffect, parameters, shape
from training.effects.truth import Truth
from training.effects.units import PPM

FREEZING = ("rate_dps", "temp_degC", "coil_temp_degC", "counter", "source")
"""What a frozen frame repeats; `source` is the simulator's own note of the row that is shown."""


class TimestampSkew(TimingEffect):
    """Conversion, queueing and gateways make a sample older than the time of its frame."""

    id = "timestamp_skew"
    title = "Time-stamp skew, transport delay"
    section = "D1"
    equation = "m(t) = ω(t − τ)"
    parameters = parameters(delay_s=shape("s", 0.005, 0.040))
    drivers = ("angular_acceleration",)
    excitation = "quick changes of rate (a chirp from 0.1 to 0.5 of the sampling rate)"
    source = "PHYSICS.md D1 [D]"

    def _delay_s(self, truth: Truth, p: SimpleNamespace, generator: np.random.Generator) -> float:
        return p.delay_s


class ClockDrift(TimingEffect):
    """The sensor's crystal and the host's run at different speeds."""

    id = "clock_drift"
    title = "Clock drift"
    section = "D2"
    equation = "m(t) = ω(t − 10⁻⁶·δ·t)"
    parameters = parameters(ppm=shape("ppm", 20.0, 50.0))
    drivers = ("angular_acceleration", "time")
    excitation = "quick changes of rate at both ends of a recording longer than 30 min"
    source = "PHYSICS.md D2 [D]"

    def _delay_s(self, truth: Truth, p: SimpleNamespace, generator: np.random.Generator) -> np.ndarray:
        return PPM * p.ppm * (truth.t_s - truth.t_s[0])


class TimingJitter(TimingEffect):
    """Arbitration and scheduling scatter the time stamps."""

    id = "timing_jitter"
    title = "Timing jitter"
    section = "D3"
    equation = "m(t) = ω(t − ε), ε normal with standard deviation σ per sample: var(e) = σ²·(dω/dt)²"
    parameters = parameters(sigma_s=shape("s", 0.5e-3, 4e-3))
    drivers = ("angular_acceleration",)
    excitation = "quick changes of rate, at low and at high bus load"
    source = "PHYSICS.md D3"

    def _delay_s(self, truth: Truth, p: SimpleNamespace, generator: np.random.Generator) -> np.ndarray:
        return p.sigma_s * generator.standard_normal(truth.t_s.size)


class FrozenFrames(FrameEffect):
    """A gateway or a sensor repeats its last frame: rate, temperature and counter stand still."""

    id = "frozen_frames"
    title = "Frozen frames"
    section = "D4"
    equation = "m(t) = ω(t_f) from t_f for the duration"
    parameters = parameters(events_per_h=shape("1/h", 6.0, 60.0), duration_s=shape("s", 0.5, 5.0))
    drivers = ("time", "angular_acceleration")
    excitation = "motion throughout, with the frame counter recorded"
    source = "PHYSICS.md D4"
    order = 10

    def _alter(self, columns: Columns, p: SimpleNamespace, generator: np.random.Generator) -> Columns:
        t = columns["t_s"]
        count = generator.poisson(p.events_per_h * (t[-1] - t[0]) / 3600.0)
        begins = np.sort(generator.uniform(t[0], t[-1], count))
        source = np.arange(t.size)
        for begin in begins:
            first, last = np.searchsorted(t, (begin, begin + p.duration_s))
            source[first:last] = source[min(first, t.size - 1)]
        return columns | {name: columns[name][source] for name in FREEZING if name in columns}


class DroppedFrames(FrameEffect):
    """A full queue or a busy bus loses frames, often several in a row."""

    id = "dropped_frames"
    title = "Dropped frames"
    section = "D4"
    equation = "a fraction of the frames is missing, in bursts of geometric length"
    parameters = parameters(fraction=shape("1", 1e-3, 1e-2), burst=shape("frames", 1.0, 5.0, default=1.0))
    drivers = ("time",)
    excitation = "the frame counter recorded, bus load low and high"
    source = "PHYSICS.md D4; Gilbert, Bell Syst. Tech. J. 39 (1960) 1253 (burst losses)"
    order = 20

    def _alter(self, columns: Columns, p: SimpleNamespace, generator: np.random.Generator) -> Columns:
        n, burst = columns["t_s"].size, max(p.burst, 1.0)
        begins = np.flatnonzero(generator.random(n) < p.fraction / burst)
        lengths = generator.geometric(1.0 / burst, begins.size)
        kept = np.ones(n, np.bool_)
        for begin, length in zip(begins, lengths, strict=True):
            kept[begin : begin + length] = False
        kept[0] = True  # a recording has a first frame
        return {name: values[kept] for name, values in columns.items()}


class CounterWrap(FrameEffect):
    """A time stamp of few bits starts again from zero: 16 bits of ms at 65.536 s, 32 of µs at 4295 s."""

    id = "counter_wrap"
    title = "Counter or time-stamp wrap"
    section = "D5"
    equation = "t_stamp = t mod W"
    parameters = parameters(wrap_s=shape("s", 2.0**32 * 1e-6, 2.0**16 * 1e-3))
    drivers = ("time",)
    excitation = "a recording longer than the wrap"
    source = "PHYSICS.md D5 [S16]"
    order = 30

    def _alter(self, columns: Columns, p: SimpleNamespace, generator: np.random.Generator) -> Columns:
        return columns | {"t_s": np.mod(columns["t_s"], p.wrap_s)}
