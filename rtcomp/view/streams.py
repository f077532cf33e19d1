"""The streams of one channel: rates, errors, correction ± its standard deviation, temperature, flags, health."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from rtcomp.frames import Flag
from rtcomp.view import colours
from rtcomp.view.columns import Elapsed, Times, send_scalars, send_states, side_by_side, style_lines
from rtcomp.view.rerun_sdk import load_rerun

SLOPE_TAU_S = 10.0  # dT/dt is taken from the temperature against its low pass of this time constant
SLOT_NS = 500_000_000  # between two temperatures
STATES_PER_BATCH = 20
GRAVE = (
    Flag.SENSOR_FAULT | Flag.FRAMES_LOST | Flag.BAD_FRAME_BEFORE | Flag.TEMPERATURE_MISSING | Flag.NO_MODEL
)
GREEN = (60, 150, 90, 255)
ORANGE, RED = (240, 170, 60, 255), (230, 80, 70, 255)
SERIES = {
    "rate": (["raw", "corrected", "reference"], [colours.RAW, colours.CORRECTED, colours.REFERENCE]),
    "error": (["before", "after"], [colours.RAW, colours.CORRECTED]),
    "correction": (["+1 σ", "−1 σ", "correction"], [colours.BAND, colours.BAND, colours.REFERENCE]),
    "temperature": (["temperature"], [colours.TEMPERATURE]),
    "temperature_rate": (["dT/dt"], [colours.TEMPERATURE]),
    "latency/p50": (["p50"], [colours.CORRECTED]),
    "latency/p99": (["p99"], [colours.RAW]),
    "losses": (
        ["receiver", "queue", "rejected", "transport", "thinned here"],
        [colours.RAW, colours.TEMPERATURE, colours.RULES, colours.CORRECTED, colours.BAND],
    ),
    "true_rate": (["true rate"], [colours.REFERENCE]),
    "history/error": (["rms before", "rms after"], [colours.RAW, colours.CORRECTED]),
    "history/correction": (["correction"], [colours.REFERENCE]),
    "history/temperature": (["temperature"], [colours.TEMPERATURE]),
}
"""Entity → the names and colours of its series."""

CURVES = {
    "error_before_dps": ("error", "before"),
    "error_after_dps": ("error", "after"),
    "temperature_degC": ("temperature", ""),
    "true_rate_dps": ("true_rate", ""),
}
"""Curves of a diagnosis → the entity, and the series in it."""


def error_columns(samples: np.ndarray) -> np.ndarray:
    """Errors against the reference before and after [°/s], shape `(n, 2)`; NaN without a reference."""
    reference = samples["ref_rate_dps"]
    return side_by_side(samples["rate_raw_dps"] - reference, samples["rate_dps"] - reference)


class ChannelStreams:
    """Logs one channel under its name. `add` takes CORRECTED arrays in order of time, `health` its 1 Hz document."""

    def __init__(self, stream: Any, name: str, times: type[Times] = Times) -> None:
        """`times`: `Elapsed` where time counts from the start of a recording."""
        self.stream, self.name, self._times = stream, name, times
        self.values = 0  # numbers logged
        self._styled: set[str] = set()
        self._flags = 0
        self._seen_flags = 0
        self._slot = -1  # half second in which a temperature was logged last
        self._slow: tuple[int, float, float] | None = None  # time [ns], T [°C], T − LP(T) [°C]

    def add(self, samples: np.ndarray) -> None:
        """Log a batch, shape `(n,)`, n > 0."""
        times, errors = self._times(samples["t_ns"]), error_columns(samples)
        known = bool(np.isfinite(errors).any())
        rates = [samples["rate_raw_dps"], samples["rate_dps"]] + ([samples["ref_rate_dps"]] if known else [])
        self._scalars("rate", times, side_by_side(*rates))
        if known:
            self._scalars("error", times, errors)
        self._scalars("correction", times, _with_band(samples))
        self._temperature(samples)
        self._log_flags(samples["t_ns"], samples["flags"])

    def _scalars(self, entity: str, times: Times, values: np.ndarray) -> None:
        path = f"{self.name}/{entity}"
        if entity not in self._styled:
            self._styled.add(entity)
            style_lines(self.stream, path, *SERIES[entity])
        send_scalars(self.stream, path, times, values)
        self.values += values.size

    def _temperature(self, samples: np.ndarray) -> None:
        """Two rows a second are enough for temperature."""
        if int(samples["t_ns"][-1]) // SLOT_NS == self._slot:
            return
        known = np.flatnonzero(np.isfinite(samples["temp_degC"]))
        if not len(known):
            return
        slots = samples["t_ns"][known] // SLOT_NS
        rows = samples[known[np.flatnonzero(np.diff(slots, prepend=self._slot))]]
        self._slot = int(slots[-1])
        if not len(rows):
            return
        slopes = [self._slope(int(row["t_ns"]), float(row["temp_degC"])) for row in rows]
        times = self._times(rows["t_ns"])
        self._scalars("temperature", times, rows["temp_degC"])
        self._scalars("temperature_rate", times, np.array(slopes) * 60.0)

    def _slope(self, t_ns: int, temp: float) -> float:
        """dT/dt [°C/s] = (T − LP(T))/τ; exact for piecewise linear T."""
        last_ns, last, lag = self._slow or (t_ns, temp, 0.0)
        elapsed = (t_ns - last_ns) / 1e9
        if 0.0 < elapsed < 60.0:
            kept = np.exp(-elapsed / SLOPE_TAU_S)
            lag = lag * kept + (temp - last) / elapsed * SLOPE_TAU_S * (1.0 - kept)
        elif elapsed:
            lag = 0.0
        self._slow = (t_ns, temp, lag)
        return lag / SLOPE_TAU_S

    def _log_flags(self, t_ns: np.ndarray, flags: np.ndarray) -> None:
        if (flags == self._flags).all():
            return
        before = np.concatenate([[self._flags], flags[:-1]]).astype(np.uint32)
        changed = before ^ flags
        for flag in Flag(int(np.bitwise_or.reduce(changed))):
            turns = np.flatnonzero(changed & np.uint32(flag))
            if len(turns):
                self._turn(flag, t_ns[turns], (flags[turns] & np.uint32(flag)) != 0)
        self._flags = int(flags[-1])

    def _turn(self, flag: Flag, t_ns: np.ndarray, on: np.ndarray) -> None:
        rr, path = load_rerun(), f"{self.name}/status/{str(flag.name).lower()}"
        if not self._seen_flags & flag:
            self._seen_flags |= flag
            tint = RED if flag & GRAVE else ORANGE
            self.stream.log(
                path, rr.StateConfiguration(values=["yes"], labels=[_words(flag)], colors=[tint]), static=True
            )
        if len(t_ns) > STATES_PER_BATCH:  # it flutters: shown as on from the first turn to the last
            t_ns, on = t_ns[[0, -1]], np.array([True, bool(on[-1])])
        send_states(self.stream, path, self._times(t_ns), ["yes" if now else "" for now in on])

    def mark(self, t_ns: int, state: str) -> None:
        """Log the stream's own state: running or paused."""
        if "status" not in self._styled:
            self._styled.add("status")
            look = load_rerun().StateConfiguration(values=["running", "paused"], colors=[GREEN, ORANGE])
            self.stream.log(f"{self.name}/status/stream", look, static=True)
        send_states(self.stream, f"{self.name}/status/stream", self._times(np.array([t_ns])), [state])

    def health(self, t_ns: int, document: dict[str, Any], missed: int, thinned: int) -> None:
        """Log latency percentiles [µs] and cumulative losses."""
        when = self._times(np.array([t_ns]))
        total = (document.get("stages_us") or {}).get("total")
        if total:
            for percentile in ("p50", "p99"):  # in plots of their own: one may be a hundred times the other
                self._scalars(f"latency/{percentile}", when, np.array([total[percentile]]))
        losses = document.get("losses") or {}
        rejected = sum((document.get("rejected") or {}).values())
        row = [losses.get("receiver", 0), losses.get("queue", 0), rejected, missed, thinned]
        self._scalars("losses", when, np.array([row], float))

    def curves(self, curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
        """Log curves of a diagnosis: quantity → (t_s, values), both `(n,)`; absent ones are left out."""
        for quantity, (entity, column) in CURVES.items():
            if quantity not in curves:
                continue
            t_s, values = curves[quantity]
            path = f"{self.name}/{entity}" + (f"/{column}" if column else "")
            names, tints = SERIES[entity]
            k = names.index(column) if column else 0
            style_lines(self.stream, path, [names[k]], [tints[k]])
            send_scalars(self.stream, path, Elapsed(np.rint(t_s * 1e9)), values)

    def history(self, t_ns: np.ndarray, means: np.ndarray) -> None:
        """Log rows of the thinned past: means of squared errors before and after, correction, temperature."""
        times = self._times(t_ns)
        if np.isfinite(means[:, :2]).any():
            self._scalars("history/error", times, np.sqrt(means[:, :2]))
        self._scalars("history/correction", times, means[:, 2])
        self._scalars("history/temperature", times, means[:, 3])


def history_columns(samples: np.ndarray) -> np.ndarray:
    """What the past is kept as, shape `(n, 4)`: see `ChannelStreams.history`."""
    before, after = error_columns(samples).T
    return side_by_side(before**2, after**2, samples["correction_dps"], samples["temp_degC"])


def _with_band(samples: np.ndarray) -> np.ndarray:
    correction, sigma = samples["correction_dps"], samples["sigma_dps"]
    return side_by_side(correction + sigma, correction - sigma, correction)


def _words(flag: Flag) -> str:
    return str(flag.name).lower().replace("_", " ")
