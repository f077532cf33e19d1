"""How the vehicle or the rate table moves: true rate and speed over time, per kind of motion.

Every kind is a small struct with a method `path(t_s, generator)` that returns (rate [°/s], speed [m/s]).
"""

from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct

from training.effects.dynamics import lowpass

Positive = Annotated[float, Meta(gt=0)]
Path = tuple[np.ndarray, np.ndarray]

_SIDE_LIMIT_MPS2 = 5.0
"""Lateral acceleration that a driver does not exceed; it bounds the rate at speed."""


class Static(Struct, frozen=True, forbid_unknown_fields=True, tag="static", tag_field="kind"):
    """Standing still."""

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return zero rate and speed, each of shape `(n,)`."""
        return np.zeros_like(t_s), np.zeros_like(t_s)


class Profile(Struct, frozen=True, forbid_unknown_fields=True, tag="profile", tag_field="kind"):
    """A polyline of rate [s, °/s], held outside, at constant speed."""

    points: Annotated[list[tuple[float, float]], Meta(min_length=1)]
    speed_mps: float = 0.0

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return the rate [°/s] and speed [m/s], each of shape `(n,)`."""
        times, rates = np.array(self.points).T
        return np.interp(t_s, times, rates), np.full_like(t_s, self.speed_mps)


class Steps(Struct, frozen=True, forbid_unknown_fields=True, tag="steps", tag_field="kind"):
    """A rate table going through levels again and again, changing at a limited acceleration."""

    levels_dps: Annotated[list[float], Meta(min_length=1)]
    dwell_s: Positive = 60.0
    accel_dps2: Positive = 40.0

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return the rate [°/s] and zero speed, each of shape `(n,)`."""
        times, rates, now, k = [0.0], [self.levels_dps[0]], 0.0, 0
        while now < t_s[-1]:
            k += 1
            level = self.levels_dps[k % len(self.levels_dps)]
            times += [now + self.dwell_s, now + self.dwell_s + abs(level - rates[-1]) / self.accel_dps2]
            rates += [rates[-1], level]
            now = times[-1]
        return np.interp(t_s, times, rates), np.zeros_like(t_s)


class Chirp(Struct, frozen=True, forbid_unknown_fields=True, tag="chirp", tag_field="kind"):
    """A linear sweep of frequency over the whole recording."""

    amplitude_dps: Positive = 20.0
    from_hz: Positive = 0.1
    to_hz: Positive = 10.0

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return the rate [°/s] and zero speed, each of shape `(n,)`."""
        slope = (self.to_hz - self.from_hz) / max(t_s[-1], 1e-9)
        phase = 2.0 * np.pi * (self.from_hz + 0.5 * slope * t_s) * t_s
        return self.amplitude_dps * np.sin(phase), np.zeros_like(t_s)


class Creep(Struct, frozen=True, forbid_unknown_fields=True, tag="creep", tag_field="kind"):
    """Slow triangular sweeps through zero rate."""

    amplitude_dps: Positive = 0.5
    period_s: Positive = 120.0
    speed_mps: float = 0.3

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return the rate [°/s] and speed [m/s], each of shape `(n,)`."""
        phase = np.mod(t_s / self.period_s + 0.25, 1.0)
        return self.amplitude_dps * (1.0 - np.abs(4.0 * phase - 2.0)), np.full_like(t_s, self.speed_mps)


class Circles(Struct, frozen=True, forbid_unknown_fields=True, tag="circles", tag_field="kind"):
    """Whole circles at each of several rates (negative: clockwise), a pause between them."""

    rates_dps: Annotated[list[float], Meta(min_length=1)]
    turns: Positive = 2.0
    pause_s: Positive = 10.0
    speed_mps: float = 3.0

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return the rate [°/s], with ramps of 2 s, and the speed [m/s] it goes with, each `(n,)`."""
        times, rates, now, k = [0.0], [0.0], 0.0, 0
        while now < t_s[-1]:
            rate = self.rates_dps[k % len(self.rates_dps)]
            length = max(360.0 * self.turns / abs(rate) - 2.0, 0.0) if rate else self.pause_s
            corners = np.cumsum([self.pause_s, 2.0, length, 2.0])
            times += list(now + corners)
            rates += [0.0, rate, rate, 0.0]
            now, k = times[-1], k + 1
        path = np.interp(t_s, times, rates)
        return path, self.speed_mps * np.minimum(np.abs(path) / max(map(abs, self.rates_dps)), 1.0)


class Drive(Struct, frozen=True, forbid_unknown_fields=True, tag="drive", tag_field="kind"):
    """A road drive drawn at random: stretches of speed with stops, turns as sin² pulses, lane keeping."""

    turns_per_min: Positive = 2.0
    peak_dps: Positive = 45.0
    speed_mps: Positive = 14.0  # mean while moving
    stops: Annotated[float, Meta(ge=0, le=1)] = 0.15  # share of stretches that are stops
    stretch_s: Positive = 40.0

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return the rate [°/s] and speed [m/s], each of shape `(n,)`."""
        count = int(np.ceil(t_s[-1] / self.stretch_s)) + 1
        levels = self.speed_mps * generator.uniform(0.3, 1.7, count)
        levels[generator.random(count) < self.stops] = 0.0
        stretch = np.minimum((t_s / self.stretch_s).astype(np.int64), count - 1)
        speed = lowpass(t_s, lowpass(t_s, levels[stretch], 2.5), 2.5)
        speed[speed < 0.05] = 0.0
        turning = _pulses(t_s, self.turns_per_min / 60.0, self.peak_dps, generator)
        keeping = _wander(t_s, 0.3, 3.0, generator)
        limit = np.degrees(_SIDE_LIMIT_MPS2 / np.maximum(speed, 0.5))
        rate = (turning + keeping) / np.sqrt(1.0 + (turning / limit) ** 2)
        return rate * np.minimum(speed / 2.0, 1.0), speed


class Parking(Struct, frozen=True, forbid_unknown_fields=True, tag="parking", tag_field="kind"):
    """Short manoeuvres to and fro at walking pace, standing still between them."""

    manoeuvres_per_min: Positive = 4.0
    peak_dps: Positive = 25.0
    speed_mps: Positive = 1.5

    def path(self, t_s: np.ndarray, generator: np.random.Generator) -> Path:
        """Return the rate [°/s] and speed [m/s], each of shape `(n,)`."""
        rate = _pulses(t_s, self.manoeuvres_per_min / 60.0, self.peak_dps, generator)
        return rate, self.speed_mps * np.minimum(np.abs(rate) / (0.3 * self.peak_dps), 1.0)


class Replay(Struct, frozen=True, forbid_unknown_fields=True, tag="replay", tag_field="kind"):
    """The motion of a recording, whose own length and sampling replace the scenario's.

    A CAN log needs `signal_map`. `truth` is the column taken for the true rate: of a log without reference
    its own rate, whose errors then count as motion. `temperature` is the recording's or the environment's.
    """

    recording: str
    columns: dict[str, str] = {}
    signal_map: str = ""
    channel: str = ""
    truth: Literal["ref_rate_dps", "rate_dps"] = "ref_rate_dps"
    temperature: Literal["recording", "environment"] = "recording"


Motion = Static | Profile | Steps | Chirp | Creep | Circles | Drive | Parking | Replay


def _pulses(t_s: np.ndarray, per_s: float, peak_dps: float, generator: np.random.Generator) -> np.ndarray:
    """Return non-overlapping turns A·sin²(πu) of 3…9 s, either sign, one after every 1/per_s on average."""
    rate = np.zeros_like(t_s)
    now = generator.exponential(0.3 / per_s)
    while now < t_s[-1]:
        length = generator.uniform(3.0, 9.0)
        height = generator.choice((-1.0, 1.0)) * peak_dps * generator.uniform(0.3, 1.0)
        first, last = np.searchsorted(t_s, (now, now + length))
        rate[first:last] = height * np.sin(np.pi * (t_s[first:last] - now) / length) ** 2
        now += length + generator.exponential(max(1.0 / per_s - 6.0, 0.5))
    return rate


def _wander(t_s: np.ndarray, rms_dps: float, tau_s: float, generator: np.random.Generator) -> np.ndarray:
    """Return lane keeping: white noise through two equal lags, scaled to its theoretical rms."""
    dt = t_s[1] - t_s[0]
    # Samples of variance v have the two-sided density v·dt, and ∫|1/(1 + sτ)²|² df = 1/(4τ).
    draw = generator.standard_normal(t_s.size) * np.sqrt(4.0 * tau_s / dt)
    return rms_dps * lowpass(t_s, lowpass(t_s, draw, tau_s), tau_s)
