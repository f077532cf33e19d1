"""The box in which surfaces stand: physical units in, scene coordinates out, axes with units, the scale's legend."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rtcomp.view import colours
from rtcomp.view.rerun_sdk import load_rerun

SIDE, HEIGHT = 2.0, 1.2  # scene lengths of the temperature and rate axes, and of the error axis
TICKS, ERROR_TICKS = 6, 5


@dataclass(frozen=True)
class Box:
    """What the scene spans: temperature [°C], rate [°/s], and errors of −limit … limit [°/s]."""

    temp_degC: tuple[float, float]
    rate_dps: tuple[float, float]
    limit_dps: float

    def place(self, temp_degC: Any, rate_dps: Any, error_dps: Any) -> np.ndarray:
        """Scene coordinates, shape `(..., 3)` float32; what lies outside is put on the boundary."""
        axes = (
            (np.asarray(temp_degC, float), self.temp_degC, SIDE),
            (np.asarray(rate_dps, float), self.rate_dps, SIDE),
            (np.asarray(error_dps, float), (-self.limit_dps, self.limit_dps), HEIGHT),
        )
        placed = [
            np.clip((v - low) / (high - low) - 0.5, -0.5, 0.5) * length for v, (low, high), length in axes
        ]
        return np.stack(np.broadcast_arrays(*placed), axis=-1).astype(np.float32)


def make_box(temp_degC: tuple[float, float], rate_dps: tuple[float, float], limit_dps: float) -> Box:
    """A box with room to see: a margin around the ranges given, empty ranges widened, the scale's end round."""
    return Box(_widened(*temp_degC), _widened(*rate_dps), _round_up(limit_dps))


def magnified(box: Box, limit_dps: float) -> Box:
    """The same ranges on another scale of errors."""
    return replace(box, limit_dps=_round_up(limit_dps))


def _widened(low: float, high: float, margin: float = 0.06, least: float = 2.0) -> tuple[float, float]:
    middle, half = (low + high) / 2.0, max((high - low) * (0.5 + margin), least / 2.0)
    return middle - half, middle + half


def _step(span: float, most: int) -> float:
    """The round step of 1, 2 or 5 times a power of ten that divides `span` into about `most` parts."""
    power = 10.0 ** math.floor(math.log10(span / most))
    return next(power * k for k in (1.0, 2.0, 5.0, 10.0) if span / (power * k) <= most * 1.01)


def _round_up(value: float) -> float:
    if not math.isfinite(value) or value <= 0.0:
        return 1e-3
    power = 10.0 ** math.floor(math.log10(value))
    return next(
        power * k
        for k in (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
        if value <= power * k * (1 + 1e-9)
    )


def ticks(low: float, high: float, most: int = TICKS) -> np.ndarray:
    """About `most` round values from low to high."""
    step = _step(high - low, most)
    return np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1) * step


def log_axes(stream: Any, path: str, box: Box) -> None:
    """Log the box's edges, ticks with units, and the colour legend under `path`."""
    rr = load_rerun()
    (t0, t1), (w0, w1), e = box.temp_degC, box.rate_dps, box.limit_dps
    floor = box.place([t0, t1, t1, t0, t0], [w0, w0, w1, w1, w0], [-e] * 5)
    posts = [box.place([t, t], [w, w], [-e, e]) for t, w in ((t0, w1), (t0, w0), (t1, w1))]
    walls = [box.place([t0, t0, t1], [w0, w1, w1], [z] * 3) for z in (0.0, e)]
    stream.log(
        f"{path}/frame",
        rr.LineStrips3D([floor, *posts, *walls], colors=[colours.LINES], radii=[-0.7]),
        static=True,
    )
    temp, rate, error = ticks(t0, t1), ticks(w0, w1), ticks(-e, e, ERROR_TICKS)
    error = error[error > -0.9 * e]  # the lowest would stand where the temperatures begin
    inset = 0.09  # labels stand off the box, so that they do not cover the surface
    places = [
        box.place(temp, w0, -e) + np.array([0.0, -inset, 0.0], np.float32),
        box.place(t1, rate, -e) + np.array([inset, 0.0, 0.0], np.float32),
        box.place(t0, w0, error) + np.array([-inset, -inset, 0.0], np.float32),
        np.array([[0.0, -SIDE / 2 - 0.45, -HEIGHT / 2], [SIDE / 2 + 0.5, 0.0, -HEIGHT / 2]], np.float32),
        np.array([[-SIDE / 2 - inset, -SIDE / 2 - inset, HEIGHT / 2 + 0.16]], np.float32),
    ]
    texts = [f"{v:g}" for axis in (temp, rate, error) for v in axis]
    texts += ["temperature [°C]", "rate [°/s]", "error [°/s]"]
    positions = np.concatenate([np.atleast_2d(place) for place in places])
    stream.log(
        f"{path}/labels",
        rr.Points3D(positions, labels=texts, show_labels=True, radii=[-0.1], colors=[colours.TEXT]),
        static=True,
    )
    _log_legend(stream, f"{path}/legend", box)


def _raised(level: Any) -> Any:
    """Heights of −1 … 1 on the legend, which stands clear of the rate axis's labels."""
    return (0.8 * level + 0.2) * HEIGHT / 2


def _log_legend(stream: Any, path: str, box: Box, steps: int = 33) -> None:
    """A bar of colours beside the box, from −limit to limit."""
    rr = load_rerun()
    levels = np.linspace(-1.0, 1.0, steps)
    left = np.stack([np.full(steps, SIDE / 2), np.full(steps, SIDE / 2 + 0.12), _raised(levels)], axis=-1)
    right = left + np.array([0.12, 0.0, 0.0])
    k = np.arange(steps - 1)
    faces = np.concatenate(
        [np.stack([k, k + 1, k + steps], -1), np.stack([k + 1, k + steps + 1, k + steps], -1)]
    )
    tint = colours.diverging(np.tile(levels, 2), 1.0)
    mesh = rr.Mesh3D(
        vertex_positions=np.concatenate([left, right]), triangle_indices=faces, vertex_colors=tint
    )
    stream.log(f"{path}/bar", mesh, static=True)
    texts = [f"{v * box.limit_dps:+.3g} °/s" if v else "0" for v in (-1.0, 0.0, 1.0)]
    ends = np.array([[SIDE / 2 + 0.3, SIDE / 2 + 0.12, _raised(v)] for v in (-1, 0, 1)])
    stream.log(
        f"{path}/scale",
        rr.Points3D(ends, labels=texts, show_labels=True, radii=[-0.1], colors=[colours.TEXT]),
        static=True,
    )
