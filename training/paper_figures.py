"""Figures 1 and 2 of the paper: the error surface the TS model has learnt, and the error left after compensation."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtcomp.compensator import predict
from training.paper import error_left, experiment, model_of
from training.rate_table import split_points


@dataclass(frozen=True)
class Surfaces:
    """Both figures of one simulated experiment. Grids have shape `(temperatures, rates)`."""

    temp_degC: np.ndarray  # (temperatures,)
    rate_dps: np.ndarray  # (rates,)
    before_dps: np.ndarray  # figure 1: the error the trained model simulates
    left_temp_degC: np.ndarray  # (temperatures,) of the table
    left_rate_dps: np.ndarray  # (rates,) of the table
    left_dps: np.ndarray  # figure 2: the error left at the table's points
    method: str
    seed: int


def surfaces(seed: int = 0, method: str = "ts_refined", nodes: int = 61) -> Surfaces:
    """Train on one simulated experiment and evaluate the model on a grid and at the table's points."""
    run = experiment(seed)
    table, protocol = run.table, run.table.protocol
    train = split_points(table)
    model = model_of(method, table, train)
    temp = np.linspace(table.temp_degC.min(), table.temp_degC.max(), nodes)
    rate = np.linspace(table.rate_dps.min(), table.rate_dps.max(), nodes)
    T, m = np.meshgrid(temp, rate, indexing="ij")
    before = predict(model, m.ravel(), T.ravel()).error_dps.reshape(T.shape)
    shape = (len(protocol.temps_degC), len(protocol.rates_dps))
    left = error_left(method, run, train).reshape(shape)
    rates = np.array(protocol.rates_dps, float)
    return Surfaces(temp, rate, before, np.array(protocol.temps_degC, float), rates, left, method, seed)


def draw(shown: Surfaces, folder: Path) -> list[Path]:
    """Write figure1 and figure2 as PNG and SVG; returns the files."""
    titles = (
        f"Figure 1: error before compensation, as {shown.method} has learnt it (simulated gyro)",
        f"Figure 2: error left after compensation by {shown.method} (simulated gyro)",
    )
    grids = (
        (shown.temp_degC, shown.rate_dps, shown.before_dps),
        (shown.left_temp_degC, shown.left_rate_dps, shown.left_dps),
    )
    folder.mkdir(parents=True, exist_ok=True)
    return [
        file
        for k, (title, grid) in enumerate(zip(titles, grids, strict=True), 1)
        for file in _draw_one(title, *grid, folder / f"figure{k}")
    ]


def _draw_one(title: str, temp: np.ndarray, rate: np.ndarray, error: np.ndarray, stem: Path) -> list[Path]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    T, m = np.meshgrid(temp, rate, indexing="ij")
    axes.plot_surface(T, m, error, cmap="viridis", linewidth=0, rcount=80, ccount=80)  # type: ignore[attr-defined]
    axes.set(xlabel="temperature [°C]", ylabel="rate [°/s]", zlabel="error [°/s]", title=title)
    files = [stem.with_suffix(ending) for ending in (".png", ".svg")]
    for file in files:
        figure.savefig(file, dpi=120)
    return files
