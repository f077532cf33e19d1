"""The error surface over temperature and rate: what the model predicts, what was measured before and after."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rtcomp.compensator import predict
from rtcomp.model import Model
from rtcomp.view import colours
from rtcomp.view.rerun_sdk import load_rerun
from rtcomp.view.scene import Box

NODES = 49
LINE_EVERY = 6  # nodes between the lines that make a surface's shape readable
LIFT = 0.004  # scene length by which lines stand above the surface


class Grid(NamedTuple):
    """Errors [°/s], shape `(temperatures, rates)`, NaN where nothing is known; the axes in °C and °/s."""

    temp_degC: np.ndarray
    rate_dps: np.ndarray
    error_dps: np.ndarray


def evaluate(models: Sequence[Model], temp_degC: tuple[float, float], rate_dps: tuple[float, float]) -> Grid:
    """The soaked error that a stack of models predicts, by the compiled step that runs in the vehicle."""
    temp, rate = np.linspace(*temp_degC, NODES), np.linspace(*rate_dps, NODES)
    T, m = np.meshgrid(temp, rate, indexing="ij")
    error = predict(list(models), m.ravel(), T.ravel()).error_dps
    return Grid(temp, rate, error.reshape(T.shape))


def log_surface(stream: Any, path: str, grid: Grid, box: Box, plain: tuple[int, ...] | None = None) -> None:
    """Log a mesh with grid lines under `path`, colour-mapped or `plain`; cells with an unknown corner are left out."""
    rr = load_rerun()
    T, m = np.meshgrid(grid.temp_degC, grid.rate_dps, indexing="ij")
    known = np.nan_to_num(grid.error_dps)
    points = box.place(T, m, known)
    mesh = rr.Mesh3D(
        vertex_positions=points.reshape(-1, 3),
        triangle_indices=_faces(np.isfinite(grid.error_dps)),
        vertex_colors=colours.diverging(known.ravel(), box.limit_dps)
        if plain is None
        else [plain] * known.size,
    )
    stream.log(f"{path}/mesh", mesh, static=True)
    raised = points + np.array([0.0, 0.0, LIFT], np.float32)
    whole = np.isfinite(grid.error_dps)
    strips = [raised[i][whole[i]] for i in _lines(len(raised))]
    strips += [raised[:, j][whole[:, j]] for j in _lines(raised.shape[1])]
    stream.log(
        f"{path}/lines", rr.LineStrips3D(strips, colors=[(60, 66, 80, 255)], radii=[-0.35]), static=True
    )


def _faces(known: np.ndarray) -> np.ndarray:
    """Two triangles for every cell whose corners are all known, shape `(faces, 3)`."""
    index = np.arange(known.size).reshape(known.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    cells = (known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]).ravel()
    corners = [np.stack([x.ravel(), y.ravel(), z.ravel()], -1)[cells] for x, y, z in ((a, b, c), (b, d, c))]
    return np.concatenate(corners).astype(np.uint32)


def _lines(nodes: int) -> np.ndarray:
    every = LINE_EVERY if nodes > 2 * LINE_EVERY else 1
    return np.unique(np.append(np.arange(0, nodes, every), nodes - 1))


def log_tiles(stream: Any, path: str, grid: Grid, box: Box) -> None:
    """Log measured cells as tiles at their mean error; the axes of `grid` are the cells' centres."""
    rr = load_rerun()
    i, j = np.nonzero(np.isfinite(grid.error_dps))
    error = grid.error_dps[i, j]
    half_T, half_w = _half_step(grid.temp_degC), _half_step(grid.rate_dps)
    signs = ((-1, -1), (1, -1), (-1, 1), (1, 1))
    corners = [
        box.place(grid.temp_degC[i] + s * half_T, grid.rate_dps[j] + r * half_w, error) for s, r in signs
    ]
    raised = np.stack(corners, axis=1).reshape(-1, 3) + np.array([0.0, 0.0, 3 * LIFT], np.float32)
    start = 4 * np.arange(len(error))[:, None]
    faces = np.concatenate([start + np.array(corner) for corner in ((0, 1, 2), (1, 3, 2))]).astype(np.uint32)
    mesh = rr.Mesh3D(
        vertex_positions=raised,
        triangle_indices=faces,
        vertex_colors=np.repeat(colours.diverging(error, box.limit_dps), 4, axis=0),
    )
    stream.log(path, mesh, static=True)


def _half_step(axis: np.ndarray) -> float:
    return float(axis[1] - axis[0]) / 2.0 * 0.94 if len(axis) > 1 else 0.5


def log_points(
    stream: Any,
    path: str,
    temp_degC: Any,
    rate_dps: Any,
    error_dps: Any,
    box: Box,
    plain: tuple[int, ...] | None = None,
) -> None:
    """Log recorded calibration points, coloured by their error [°/s] or `plain`; arrays of shape `(n,)`."""
    rr = load_rerun()
    tint = colours.diverging(np.asarray(error_dps), box.limit_dps) if plain is None else [plain]
    places = box.place(temp_degC, rate_dps, error_dps) + np.array([0.0, 0.0, 2 * LIFT], np.float32)
    radius = 0.014 if plain is None else 0.011
    stream.log(path, rr.Points3D(places, colors=tint, radii=[radius]), static=True)


def log_rules(stream: Any, path: str, models: Sequence[Model], box: Box) -> None:
    """Log every rule's centre on the surface and its width (1 σ) as an ellipse on the floor."""
    rr = load_rerun()
    centers, widths = _rules_of(models, box)
    if not len(centers):
        return
    angle = np.linspace(0.0, 2.0 * np.pi, 65)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    floor = -box.limit_dps
    outlines = [center + circle * width for center, width in zip(centers, widths, strict=True)]
    rings = [
        box.place(ring[:, 0], ring[:, 1], floor) + np.array([0, 0, LIFT], np.float32) for ring in outlines
    ]
    T, w = np.clip(centers, [box.temp_degC[0], box.rate_dps[0]], [box.temp_degC[1], box.rate_dps[1]]).T
    height = predict(list(models), w, T).error_dps
    tops = box.place(T, w, height)
    stems = np.stack([box.place(T, w, floor), tops], axis=1)
    lowest = np.concatenate(rings)[np.argmin(np.concatenate(outlines)[:, 1])]
    log_note(stream, f"{path}/label", lowest, "rules, 1 σ")
    stream.log(f"{path}/widths", rr.LineStrips3D(rings, colors=[colours.RULES], radii=[-0.8]), static=True)
    stream.log(
        f"{path}/stems", rr.LineStrips3D(list(stems), colors=[colours.RULES], radii=[-0.4]), static=True
    )
    names = [f"rule {k + 1}" for k in range(len(tops))]
    dots = rr.Points3D(tops, colors=[colours.RULES], radii=[0.025], labels=names, show_labels=False)
    stream.log(f"{path}/centers", dots, static=True)


def log_note(stream: Any, path: str, place: np.ndarray, text: str) -> None:
    """Log a short text at a place of the scene, shape `(3,)`."""
    note = load_rerun().Points3D(
        [place], labels=[text], show_labels=True, radii=[-0.1], colors=[colours.TEXT]
    )
    stream.log(path, note, static=True)


def _rules_of(models: Sequence[Model], box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Centres and widths over (temperature, rate), shape `(rules, 2)`; an input a rule lacks spans the whole box."""
    rows: list[list[tuple[float, float]]] = []
    for model in models:
        for center, width in zip(model.rules.centers, model.rules.widths, strict=True):
            known = dict(zip(model.inputs, zip(center, width, strict=True), strict=True))
            pair = [known.get(name, _whole(getattr(box, name))) for name in ("temp_degC", "rate_dps")]
            rows.append(pair)
    table = np.array(rows, float).reshape(-1, 2, 2)
    return table[:, :, 0], table[:, :, 1]


def _whole(limits: tuple[float, float]) -> tuple[float, float]:
    return (limits[0] + limits[1]) / 2.0, (limits[1] - limits[0]) / 2.0


def log_validity(stream: Any, path: str, models: Sequence[Model], box: Box) -> None:
    """Log the region in which the models are valid, as a box's edges; outside, inputs are clipped and flagged."""
    rr = load_rerun()
    temp, rate = valid_range(models, "temp_degC"), valid_range(models, "rate_dps")
    if temp is None and rate is None:
        return
    (t0, t1), (w0, w1) = temp or box.temp_degC, rate or box.rate_dps
    ring = [(t0, w0), (t1, w0), (t1, w1), (t0, w1), (t0, w0)]
    T, w = np.array(ring).T
    edges = [box.place(T, w, z) for z in (-box.limit_dps, box.limit_dps)]
    edges += [box.place([t, t], [r, r], [-box.limit_dps, box.limit_dps]) for t, r in ring[:4]]
    stream.log(path, rr.LineStrips3D(edges, colors=[colours.VALIDITY], radii=[-0.6]), static=True)
    log_note(stream, f"{path}/label", box.place(t0, w1, box.limit_dps), "valid range")


def valid_range(models: Sequence[Model], name: str) -> tuple[float, float] | None:
    """The range of an input in which all models of the stack are valid; None where none states one."""
    ranges = [model.validity[name] for model in models if name in model.validity]
    return (max(low for low, _ in ranges), min(high for _, high in ranges)) if ranges else None
