"""The same cases through what others would use: sparse regression, a Gaussian process, a black box.

Each gets the residual (measured minus simulated, offset and scale removed) and the columns an engineer would try.
A peer "finds" when its own default criterion keeps anything: a non-zero coefficient, a better likelihood, a
cross-validated R² above 5 %.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from tools.blind.noise import basis
from tools.blind.proof import against_oracle, lasting
from tools.blind.sealing import open_case
from tools.blind.summary import rate, spread
from tools.blind.trial import Told, in_parallel
from training.table import Recording, read_recording

Document = dict[str, Any]
BLOCKS, GP_BLOCKS = 4000, 200
SPARSE = ("stlsq", "lasso")


@dataclass(frozen=True)
class Answer:
    """Whether something was found, its names (strongest first; empty where the method has none), and a predictor."""

    found: bool
    names: list[str]
    predict: Callable[[np.ndarray], np.ndarray]


def features(recording: Recording) -> tuple[list[str], np.ndarray]:
    """Catalogue names and columns, shape (n, k), that an engineer's library would have."""
    reference = recording.get("ref_rate_dps")
    temp = recording["temp_degC"] - 25.0
    w = np.zeros(len(temp)) if reference is None else reference
    columns = {"bias_temperature": temp, "bias_temperature#2": temp**2, "bias_temperature#3": temp**3}
    columns |= {"scale_temperature": w * temp, "scale_temperature#2": w * temp**2}
    columns |= {"scale_nonlinearity": w**3, "scale_asymmetry": np.abs(w)}
    t = recording.get("t_s")
    if t is not None:
        dt = float(np.median(np.diff(t)))
        slope, spin = _slope(temp, dt, 60.0), _slope(w, dt, 0.0)
        early = np.exp(-t / 600)
        columns |= {
            "shupe": slope,
            "scale_temperature_rate": w * slope,
            "bias_drift": t,
            "source_ageing": w * t,
        }
        columns |= {
            "bias_warmup": early,
            "scale_warmup": w * early,
            "timestamp_skew": spin,
            "clock_drift": spin * t,
        }
    if "heading_deg" in recording:
        psi = np.radians(recording["heading_deg"])
        columns |= {"magnetic": np.cos(psi), "magnetic#2": np.sin(psi)}
        columns |= {"table_eccentricity": w * np.cos(psi), "table_eccentricity#2": w * np.sin(psi)}
    if "accel_lat_mps2" in recording:
        columns["acceleration"] = recording["accel_lat_mps2"]
    if "vibration_rms_mps2" in recording:
        columns["vibration_rectification"] = recording["vibration_rms_mps2"] ** 2
    return [name.split("#")[0] for name in columns], np.column_stack(list(columns.values()))


def _slope(values: np.ndarray, dt_s: float, window_s: float) -> np.ndarray:
    n = max(1, int(window_s / dt_s)) | 1
    smooth = (
        np.convolve(np.pad(values, n // 2, mode="edge"), np.full(n, 1 / n), mode="valid") if n > 1 else values
    )
    return np.gradient(smooth, dt_s)


def residual(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Measured minus simulated without its own offset and scale [°/s], and the rate it was scaled by, shape (n,)."""
    reference = next((recording[c] for c in ("sim_rate_dps", "ref_rate_dps") if c in recording), None)
    base = np.zeros(len(recording)) if reference is None else reference
    error = recording["rate_dps"] - base
    q = basis(np.column_stack([c for c in (np.ones(len(base)), base) if np.any(c)]))
    return error - q @ (q.T @ error), base


def _blocks(values: np.ndarray, count: int) -> np.ndarray:
    """Means over at most `count` blocks of rows."""
    size = max(1, len(values) // count)
    rows = len(values) // size * size
    return values[:rows].reshape(-1, size, *values.shape[1:]).mean(axis=1)


def _standard(X: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    mean, std = X.mean(axis=0), X.std(axis=0)
    std[std == 0] = np.inf
    return lambda raw: (raw - mean) / std


def _sparse(
    coefficients: np.ndarray, names: list[str], predict: Callable[[np.ndarray], np.ndarray]
) -> Answer:
    order = np.argsort(-np.abs(coefficients))
    kept = [names[i] for i in order if coefficients[i] != 0]
    return Answer(bool(kept), list(dict.fromkeys(kept)), predict)


def stlsq(X: np.ndarray, y: np.ndarray, names: list[str]) -> Answer:
    """pySINDy's sequentially thresholded least squares, threshold 0.1 on standardised columns and residual."""
    from pysindy.optimizers import STLSQ  # pyright: ignore[reportMissingImports] (optional)

    scale, size = _standard(X), y.std()
    fitted = STLSQ(threshold=0.1, alpha=0.05).fit(scale(X), (y / size)[:, None])
    weights = np.ravel(fitted.coef_)
    return _sparse(weights, names, lambda raw: size * scale(raw) @ weights)


def lasso(X: np.ndarray, y: np.ndarray, names: list[str]) -> Answer:
    """Lasso with its penalty from five-fold cross-validation."""
    from sklearn.linear_model import LassoCV

    scale = _standard(X)
    fitted = LassoCV(cv=5, random_state=0).fit(scale(X), y)
    return _sparse(fitted.coef_, names, lambda raw: np.asarray(fitted.predict(scale(raw))))


def gaussian_process(X: np.ndarray, y: np.ndarray, names: list[str]) -> Answer:
    """Gaussian process with a length scale per column; found when its likelihood beats white noise by e⁶."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    scale, size = _standard(X), y.std()
    Z, z = _blocks(scale(X), GP_BLOCKS), _blocks(y / size, GP_BLOCKS)
    scales: Any = np.full(X.shape[1], 3.0)
    kernel = ConstantKernel(1.0) * RBF(scales, (0.1, 1e3)) + WhiteKernel(1.0)
    fitted = GaussianProcessRegressor(kernel, random_state=0).fit(Z, z)
    white = -0.5 * len(z) * (np.log(2 * np.pi * z.var()) + 1)
    likelihood: Any = fitted.log_marginal_likelihood_value_
    better = likelihood > white + 6
    return Answer(bool(better), [], lambda raw: size * np.asarray(fitted.predict(scale(raw))))


def boosting(X: np.ndarray, y: np.ndarray, names: list[str]) -> Answer:
    """Gradient boosted trees; found when random five-fold cross-validation gives R² above 5 %."""
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.model_selection import KFold, cross_val_score

    trees = HistGradientBoostingRegressor(max_iter=60, random_state=0)
    r2 = cross_val_score(trees, X, y, cv=KFold(5, shuffle=True, random_state=0)).mean()
    fitted = trees.fit(X, y)
    return Answer(bool(r2 > 0.05), [], lambda raw: np.asarray(fitted.predict(raw)))


METHODS = {"stlsq": stlsq, "lasso": lasso, "gaussian_process": gaussian_process, "boosting": boosting}


def available() -> list[str]:
    """The peers that can run here: PySINDy is installed for this comparison only."""
    return [name for name in METHODS if name != "stlsq" or find_spec("pysindy") is not None]


def peer_case(folder: Path, seal: str) -> Document:
    """Every peer on one case: found or not, names, and what of the held-out misfit its prediction removes."""
    truth, arrays = open_case(folder, seal)
    training, heldout = (
        read_recording(folder / "seen" / f"{n}.parquet") for n in ("recording-1", "heldout-1")
    )
    names, X = features(training)
    error, _ = residual(training)
    Xb, yb = _blocks(X, BLOCKS), _blocks(error, BLOCKS)
    out: Document = {"level": truth["level"], "truth": [e["effect"] for e in truth["effects"]]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in available():
            answer = METHODS[name](Xb, yb, names)
            ratio = _heldout_ratio(answer, heldout, truth, arrays)
            out[name] = {"found": answer.found, "names": answer.names, "misfit_ratio": ratio}
    return out


def _heldout_ratio(
    answer: Answer, heldout: Recording, truth: Document, arrays: dict[str, np.ndarray]
) -> float | None:
    if not lasting(truth):
        return None
    told = against_oracle(heldout, "heldout-1", answer.predict(features(heldout)[1]), truth, arrays)
    return told["misfit_ratio"] if told["oracle_gain"] > 60 else None


def run_peers(root: Path, seals: dict[str, str], jobs: int, told: Told) -> Document:
    """All peers that are installed on all cases (PySINDy: pip install pysindy)."""
    tasks = {name: (root / name, seal) for name, seal in seals.items()}
    rows = [future.result() for _, future in in_parallel(jobs, peer_case, tasks, told)]
    nulls = [r for r in rows if not r["truth"]]
    singles = [r for r in rows if len(r["truth"]) == 1 and r["level"] in ("L1", "L2")]
    return {
        peer: {
            "false_alarm": rate([r[peer]["found"] for r in nulls]),
            "truth_is_first_name": rate(
                [r[peer]["names"][:1] == r["truth"] for r in singles if peer in SPARSE]
            ),
            "truth_among_names": rate([r["truth"][0] in r[peer]["names"] for r in singles if peer in SPARSE]),
            "names_per_case": spread([len(r[peer]["names"]) for r in rows if peer in SPARSE]),
            "heldout_misfit_ratio": spread([r[peer]["misfit_ratio"] for r in rows]),
        }
        for peer in available()
    }
