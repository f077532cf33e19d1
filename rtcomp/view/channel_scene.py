"""The 3D scenes of one channel: surfaces before and after (on one scale, and magnified), rules, validity, trail."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rtcomp.model import Model, ResidualTable
from rtcomp.view import colours
from rtcomp.view.cells import Cells
from rtcomp.view.columns import Times
from rtcomp.view.rerun_sdk import load_rerun
from rtcomp.view.scene import Box, log_axes, magnified, make_box
from rtcomp.view.streams import error_columns
from rtcomp.view.surface import (
    LIFT,
    Grid,
    evaluate,
    log_rules,
    log_surface,
    log_tiles,
    log_validity,
    valid_range,
)

SIDES = ("before", "after", "magnified")
"""The scenes of a channel: both errors on one scale, and what is left on its own."""

TRAIL_POINTS, TRAIL_STEP_NS = 120, 200_000_000  # 24 s
"""How much of its way the operating point drags along."""
FIRST_LOOK_S, SLOWER = 1.0, 1.3  # measured surfaces are logged after 1 s, and then less and less often …
SLOWEST_S = 30.0  # … but never less often than this
SMALLER = 0.4  # the magnified scale is made anew when what is left fills less than this part of it
POLE = 0.45  # scene length by which the operating point's label stands above it


def fitting_box(models: Sequence[Model], temp: np.ndarray, rate: np.ndarray, error: np.ndarray) -> Box:
    """A box around the models' validity and the samples given (arrays of any length; NaN is left out)."""
    temps = [*(valid_range(models, "temp_degC") or ()), *_ends(temp)]
    rates = [*(valid_range(models, "rate_dps") or ()), *_ends(rate)]
    spans = (
        (min(temps, default=-40.0), max(temps, default=85.0)),
        (min(rates, default=-60.0), max(rates, default=60.0)),
    )
    limit = max([float(np.abs(evaluate(models, *spans).error_dps).max())] if models else [0.0])
    measured = np.abs(error[np.isfinite(error)])
    return make_box(*spans, max(limit, float(np.quantile(measured, 0.999)) if len(measured) else 0.0))


def _ends(values: np.ndarray) -> list[float]:
    known = values[np.isfinite(values)]
    return [float(known.min()), float(known.max())] if len(known) else []


class Way(NamedTuple):
    """Where the sensor was: correction on the surface before, error left on the one after (0 when not known)."""

    t_ns: int
    temp_degC: float
    rate_dps: float
    correction_dps: float
    left_dps: float


class ChannelScene:
    """Settings: the models. State: the box, the cells measured, the trail. Update: `add` with every batch."""

    def __init__(self, stream: Any, name: str, models: Sequence[Model], times: type[Times] = Times) -> None:
        """`times` as of `ChannelStreams`."""
        self.stream, self.root, self.models, self._times = stream, f"{name}/surface", list(models), times
        self.cells: Cells | None = None  # with the box they stand in, once that is known
        self._magnified: Box | None = None  # the same box on the scale of what is left
        self._trail: deque[Way] = deque(maxlen=TRAIL_POINTS)
        self._due_ns, self._wait_s = 0, FIRST_LOOK_S

    def add(self, samples: np.ndarray) -> None:
        """Take in a batch of CORRECTED samples, shape `(n,)`, n > 0; rows without a temperature are left out."""
        samples = samples[np.isfinite(samples["temp_degC"])]
        if not len(samples):
            return
        errors = error_columns(samples)
        cells = self.cells
        if cells is None or self._outgrown(cells.box, samples, errors):
            cells = self._build(samples, errors)
        cells.add(samples["temp_degC"], samples["rate_raw_dps"], errors)
        self._move(cells.box, samples)
        self._show_measured(cells, int(samples["t_ns"][-1]))

    def prepare(self, samples: np.ndarray) -> Box:
        """Make the scene fit samples that are all known already; returns its box."""
        return self._build(samples, error_columns(samples)).box

    def swap(self, models: Sequence[Model]) -> None:
        """Show other models from now on."""
        self.models, self.cells, self._magnified = list(models), None, None

    def _outgrown(self, box: Box, samples: np.ndarray, errors: np.ndarray) -> bool:
        """Whether a scene without stated validity has become too small."""
        if self.models and valid_range(self.models, "temp_degC") and valid_range(self.models, "rate_dps"):
            return False
        sizes = (samples["temp_degC"], box.temp_degC), (samples["rate_raw_dps"], box.rate_dps)
        seen = np.abs(errors[:, 0][np.isfinite(errors[:, 0])])
        big = len(seen) > 0 and float(np.quantile(seen, 0.99)) > 1.5 * box.limit_dps
        return big or any(float(v.min()) < low or float(v.max()) > high for v, (low, high) in sizes)

    def _build(self, samples: np.ndarray, errors: np.ndarray) -> Cells:
        temp, rate = samples["temp_degC"], samples["rate_raw_dps"]
        if self.cells is not None:  # what was seen stays inside
            temp, rate = np.append(temp, self.cells.box.temp_degC), np.append(rate, self.cells.box.rate_dps)
        box = fitting_box(self.models, temp, rate, errors[:, 0])
        self.cells = Cells(box)
        self._due_ns, self._wait_s = 0, FIRST_LOOK_S
        log_model_scene(self.stream, self.root, self.models, box)
        return self.cells

    def _move(self, box: Box, samples: np.ndarray) -> None:
        last = samples[-1]
        left = float(last["rate_dps"] - last["ref_rate_dps"])
        here = Way(
            int(last["t_ns"]),
            float(last["temp_degC"]),
            float(last["rate_raw_dps"]),
            float(last["correction_dps"]),
            left if np.isfinite(left) else 0.0,
        )
        step = here.t_ns - self._trail[-1].t_ns if self._trail else TRAIL_STEP_NS
        if 0 <= step < TRAIL_STEP_NS:
            return
        if step < 0:
            self._trail.clear()  # a replay began anew
        self._trail.append(here)
        boxes = {"before": box, "after": box} | ({"magnified": self._magnified} if self._magnified else {})
        log_operating_point(self.stream, self.root, boxes, list(self._trail), self._times)

    def _show_measured(self, cells: Cells, t_ns: int) -> None:
        if 0 <= self._due_ns - t_ns < SLOWEST_S * 1e9 or not len(cells):
            return
        self._due_ns = t_ns + round(self._wait_s * 1e9)
        self._wait_s = min(self._wait_s * SLOWER, SLOWEST_S)
        before, after = cells.means()
        log_tiles(self.stream, f"{self.root}/before/measured", before, cells.box)
        log_tiles(self.stream, f"{self.root}/after/measured", after, cells.box)
        log_tiles(self.stream, f"{self.root}/magnified/measured", after, self._magnify(after, cells.box))

    def _magnify(self, after: Grid, box: Box) -> Box:
        """The box on a scale that what is left fills; logs its axes when that changes."""
        largest = float(np.nanmax(np.abs(after.error_dps)))
        scale = self._magnified
        if scale is None or not SMALLER * scale.limit_dps <= largest <= scale.limit_dps:
            scale = self._magnified = magnified(box, largest)
            log_axes(self.stream, f"{self.root}/magnified/axes", scale)
        return scale

    def finish(self) -> None:
        """Log what was measured up to the end."""
        if self.cells is not None:
            self._due_ns = 0
            self._show_measured(self.cells, 2**62)


def log_model_scene(stream: Any, root: str, models: Sequence[Model], box: Box) -> None:
    """Log what a model says: its surface with rules and validity before, ± its standard deviation after."""
    for side in ("before", "after"):
        log_axes(stream, f"{root}/{side}/axes", box)
    if not models:
        return
    inside = [valid_range(models, name) or getattr(box, name) for name in ("temp_degC", "rate_dps")]
    log_surface(stream, f"{root}/before/model", evaluate(models, *inside), box)
    log_rules(stream, f"{root}/before/rules", models, box)
    log_validity(stream, f"{root}/before/validity", models, box)
    log_validity(stream, f"{root}/after/validity", models, box)
    sigma = residual_sigma(models)
    if sigma is not None:
        log_sigma(stream, f"{root}/after/sigma", sigma, inside, box)


def residual_sigma(models: Sequence[Model]) -> float | None:
    """The largest standard deviation [°/s] of what the last model leaves; None where it states none."""
    residual = models[-1].residual_std_dps
    if isinstance(residual, ResidualTable):
        return max(max(row) for row in residual.std_dps)
    return residual


def log_sigma(stream: Any, path: str, sigma: float, inside: list[tuple[float, float]], box: Box) -> None:
    """Log the frames ±σ between which the error left is expected, and grey where none has been measured."""
    (t0, t1), (w0, w1) = inside
    rr = load_rerun()
    rings = [box.place([t0, t1, t1, t0, t0], [w0, w0, w1, w1, w0], z) for z in (-sigma, sigma)]
    stream.log(path, rr.LineStrips3D(rings, colors=[colours.BAND], radii=[-0.8]), static=True)
    flat = Grid(np.linspace(t0, t1, 9), np.linspace(w0, w1, 9), np.zeros((9, 9)))
    log_surface(stream, f"{path}/unmeasured", flat, box, plain=colours.UNMEASURED)


def log_operating_point(
    stream: Any, root: str, boxes: Mapping[str, Box], way: list[Way], times: type[Times] = Times
) -> None:
    """Log where the sensor is now, on every surface (by the names of their boxes), and the way it came."""
    rr = load_rerun()
    when = [times(np.array([way[-1].t_ns]))]
    rows = np.array([row[1:] for row in way])
    for side, box in boxes.items():
        error = rows[:, 2] if side == "before" else rows[:, 3]
        places = box.place(rows[:, 0], rows[:, 1], error) + np.array([0.0, 0.0, 4 * LIFT], np.float32)
        top = places[-1] + np.array([0.0, 0.0, POLE], np.float32)
        at = f"{root}/{side}"
        lines = rr.LineStrips3D.columns(strips=[places, np.stack([places[-1], top])]).partition([2])
        stream.send_columns(f"{at}/trail", indexes=when, columns=lines)
        for leaf, place in (("operating_point", places[-1:]), ("operating_point/label", top[None])):
            stream.send_columns(f"{at}/{leaf}", indexes=when, columns=rr.Points3D.columns(positions=place))


def style_operating_point(stream: Any, root: str) -> None:
    """Size and colours of the operating point, its label and its trail."""
    rr = load_rerun()
    for side in SIDES:
        point = rr.Points3D.from_fields(radii=[0.035], colors=[colours.TRAIL])
        stream.log(f"{root}/{side}/operating_point", point, static=True)
        label = rr.Points3D.from_fields(radii=[-0.1], colors=[colours.TEXT], labels=["now"], show_labels=True)
        stream.log(f"{root}/{side}/operating_point/label", label, static=True)
        trail = rr.LineStrips3D.from_fields(radii=[0.008], colors=[colours.TRAIL])
        stream.log(f"{root}/{side}/trail", trail, static=True)
