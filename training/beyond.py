"""Past the paper: extrapolation, coverage of the stated uncertainty, a surface on which the printed method works."""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from rtcomp.compensator import predict
from rtcomp.model import Model
from training.paper import error_left, experiment, model_of
from training.rate_table import RateTable, ReferenceGyro, split_inside, split_points, split_soaks
from training.simulator.scenario import Surface
from training.validity import coverage, held_out_residuals, residual_table

INSIDE_DEGC = (-10.0, 40.0)
INSIDE_DPS = 120.0
EXTRAPOLATORS = (
    "linear_bilinear",
    "lssvm",
    "bp_neural",
    "lookup_table",
    "gaussian_process",
    "ts_refined",
    "physics_informed",
    "oracle",
)
STATING = ("ts_refined", "physics_informed")
GENTLE = ReferenceGyro(Surface(K0_s=0.02, alpha_per_K=0.0, g0=0.043, g1_per_K=-30e-6, g2_per_K2=0.0))
"""A closed-loop gyro (no sine) with a plain 4.3 % scale error and 30 ppm/K: nearly a plane over the inputs."""


def extrapolation(seeds: int, tell: Callable[[str], None]) -> dict[str, Any]:
    """Trained inside −10…40 °C and ±120 °/s, tested outside: medians over seeds of the largest error [°/s].

    `measured` is against the table's readings, whose soaks repeat to 280 ppm only: the oracle's row is the floor of
    that column. `surface` is against the true surface, which is what a model extrapolates.
    """
    measured, surface = np.empty((seeds, len(EXTRAPOLATORS))), np.empty((seeds, len(EXTRAPOLATORS)))
    with threadpool_limits(1):
        for seed in range(seeds):
            run = experiment(seed)
            train = split_inside(run.table, INSIDE_DEGC, INSIDE_DPS)
            noise = error_left("oracle", run, train)
            for k, method in enumerate(EXTRAPOLATORS):
                tell(f"extrapolation, seed {seed}, {method}")
                left = error_left(method, run, train)
                measured[seed, k] = np.abs(left[~train]).max()
                surface[seed, k] = np.abs((left - noise)[~train]).max()
    return {
        method: {"measured": float(np.median(measured[:, k])), "surface": float(np.median(surface[:, k]))}
        for k, method in enumerate(EXTRAPOLATORS)
    }


def coverages(seeds: int, tell: Callable[[str], None]) -> dict[str, float]:
    """Share of held-out whole soaks' errors within the stated 95 % intervals, pooled over seeds."""
    shares: dict[str, list[float]] = {method: [] for method in STATING}
    with threadpool_limits(1):
        for seed in range(seeds):
            table = experiment(seed).table
            train = split_soaks(table)
            for method in STATING:
                tell(f"coverage, seed {seed}, {method}")
                shares[method].append(_share(stating_model(method, table, train), table, ~train))
    return {method: float(np.mean(values)) for method, values in shares.items()}


def stating_model(method: str, table: RateTable, train: np.ndarray) -> Model:
    """A model with its residual table, both from the rows `train` alone."""
    rows = np.flatnonzero(train)

    def again(inner: np.ndarray, test: np.ndarray) -> np.ndarray:
        chosen = np.zeros(len(train), bool)
        chosen[rows[inner]] = True
        model = model_of(method, table, chosen)
        return predict(model, table.rate_dps[rows[test]], table.temp_degC[rows[test]]).error_dps

    left = held_out_residuals(table.soak[rows], again, table.error_dps[rows])
    stated = residual_table(table.temp_degC[rows], table.rate_dps[rows], left, table.soak[rows])
    return msgspec.structs.replace(model_of(method, table, train), residual_std_dps=stated)


def _share(model: Model, table: RateTable, rows: np.ndarray) -> float:
    given = predict(model, table.rate_dps[rows], table.temp_degC[rows])
    return coverage(table.error_dps[rows] - given.error_dps, given.sigma_dps)


def gentle(seeds: int, tell: Callable[[str], None]) -> dict[str, dict[str, float]]:
    """The printed algorithm on GENTLE: medians of the largest and the standard deviation on validation [°/s]."""
    methods = ("uncompensated", "linear_plane", "ts_gk_rls_printed", "ts_gk_rls", "oracle")
    found = np.empty((seeds, len(methods), 2))
    with threadpool_limits(1):
        for seed in range(seeds):
            run = experiment(seed, GENTLE)
            train = split_points(run.table)
            for k, method in enumerate(methods):
                tell(f"gentle surface, seed {seed}, {method}")
                found[seed, k] = _two(error_left(method, run, train)[~train])
    middle = np.median(found, axis=0)
    return {
        m: {"valid_max": float(middle[k, 0]), "valid_std": float(middle[k, 1])} for k, m in enumerate(methods)
    }


def _two(left: np.ndarray) -> Sequence[float]:
    return float(np.abs(left).max()), float(left.std())
