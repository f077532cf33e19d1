"""TS with a dynamic term: the static rules plus thermal lag, e = (w·scale + bias)·(LP_τ(T) − T), fitted jointly.

The time constant is searched on a grid, everything linear is solved at each of its points. A lag is claimed only
when it lowers the error of the training rows beyond doubt, does so better than a drift in time over the same
rows (which nobody may extrapolate), and its time constant lies inside what the recording can tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtcomp.model import Model, Term
from training.build import ts_model
from training.groups import BLOCKS, blocks
from training.inputs import ROTATING_DPS, Checked, input_columns, lagged
from training.refine import Antecedents, refine
from training.regressors import regressors
from training.scores import ratio_interval
from training.ts import REFINE_ROWS, Scaling, TsFit, TsOptions, fit

SHORTEST_S = 20.0
LONGEST = 1 / 3  # of the training rows' duration: a longer time constant looks like a drift
POINTS = 24


@dataclass(frozen=True)
class DynamicFit:
    """The model, whether it holds a lag, and why."""

    model: Model
    claimed: bool
    sentence: str
    tau_s: float
    std_static_dps: float
    std_lag_dps: float
    std_drift_dps: float


@dataclass(frozen=True)
class _Rows:
    """Training rows of all recordings put end to end."""

    inputs: np.ndarray
    error: np.ndarray
    rate: np.ndarray
    time: np.ndarray
    block: np.ndarray


def fit_dynamic(
    recordings: Sequence[Checked],
    masks: Sequence[np.ndarray] | None = None,
    options: TsOptions | None = None,
) -> DynamicFit:
    """Fit static rules and, if it can be claimed, a thermal lag.

    `masks` choose the training rows of each recording (all by default); thermal states run through all rows, as
    they would in the vehicle. Recordings need `t_s`. Raises RequestError as `training.ts.fit` does.
    """
    options = options or TsOptions()
    masks = masks if masks is not None else [np.ones(len(item.recording), bool) for item in recordings]
    pairs = [(item, mask) for item, mask in zip(recordings, masks, strict=True) if mask.any()]
    recordings, masks = [item for item, _ in pairs], [mask for _, mask in pairs]
    turning = _rotating(recordings, masks)
    names = ["temp_degC", "rate_dps"] if turning else ["temp_degC"]
    rows = _gather(recordings, masks, names)
    static = fit(rows.inputs, rows.error, names, options)
    taus = np.geomspace(SHORTEST_S, max(LONGEST * _duration(recordings, masks), 2 * SHORTEST_S), POINTS)
    scaling = Scaling(rows.inputs.mean(axis=0), rows.inputs.std(axis=0))
    start = _antecedents(static, scaling)
    every = slice(None, None, -(-len(rows.error) // REFINE_ROWS))
    thin = _Rows(*(getattr(rows, name)[every] for name in ("inputs", "error", "rate", "time", "block")))
    z = scaling.to_z(thin.inputs)
    left_static = _left(z, start, thin.error, None)[1]
    left_drift = _left(z, start, thin.error, _times(thin.time - thin.time.mean(), thin.rate, turning))[1]
    trials = [_left(z, start, thin.error, _lag(recordings, masks, tau, turning)[every])[1] for tau in taus]
    best = int(np.argmin([left @ left for left in trials]))
    claimed, sentence = judge(taus, best, left_static, trials[best], left_drift, thin.block)
    stds = [float(np.std(left)) for left in (left_static, trials[best], left_drift)]
    if claimed:
        columns = _lag(recordings, masks, float(taus[best]), turning)
        model = _with_lag(rows, columns, every, scaling, start, float(taus[best]), names, options)
    else:
        model = ts_model(static, names, rows.inputs)
    return DynamicFit(model, claimed, sentence, float(taus[best]), *stds)


def judge(
    taus: np.ndarray, best: int, static: np.ndarray, lag: np.ndarray, drift: np.ndarray, blocks: np.ndarray
) -> tuple[bool, str]:
    """Whether residuals without, with a lag and with a drift in time allow to claim the lag, and why."""
    gain = ratio_interval(lag, static, blocks)
    std = [1e3 * float(np.std(left)) for left in (static, lag, drift)]
    told = f"error left {std[0]:.1f} m°/s static, {std[1]:.1f} with a lag of {taus[best]:.0f} s"
    told += f", {std[2]:.1f} with a drift in time"
    if gain is None or gain[0] <= 1.0:
        return False, f"no lag claimed: {told}; the gain is within chance"
    if std[2] <= std[1]:
        return False, f"no lag claimed: {told}; a drift in time explains it as well, and is not extrapolated"
    if best in (0, len(taus) - 1):
        return False, f"no lag claimed: {told}; its time constant is at the edge of what these rows can tell"
    return True, f"thermal lag: {told}"


def branches(temp_degC: np.ndarray) -> np.ndarray:
    """Branch of every row of a chamber cycle: 0 to the coldest, 1 to the hottest after it, 2 from there."""
    coldest = int(np.argmin(temp_degC))
    hottest = coldest + int(np.argmax(temp_degC[coldest:]))
    row = np.arange(len(temp_degC))
    return (row > coldest).astype(int) + (row > hottest)


def _rotating(recordings: Sequence[Checked], masks: Sequence[np.ndarray]) -> bool:
    rates = np.concatenate([item.true_dps[mask] for item, mask in zip(recordings, masks, strict=True)])
    return bool(np.std(rates) > ROTATING_DPS)


def _duration(recordings: Sequence[Checked], masks: Sequence[np.ndarray]) -> float:
    return max(float(np.ptp(r.recording["t_s"][mask])) for r, mask in zip(recordings, masks, strict=True))


def _gather(recordings: Sequence[Checked], masks: Sequence[np.ndarray], names: Sequence[str]) -> _Rows:
    pairs = list(zip(recordings, masks, strict=True))
    time = [r.recording["t_s"][mask] for r, mask in pairs]
    many = len(pairs) > 1 and len(pairs) >= BLOCKS // 2
    block = [np.full(len(t), k) if many else k * BLOCKS + blocks(len(t)) for k, t in enumerate(time)]
    return _Rows(
        np.concatenate([input_columns(r.recording, names)[mask] for r, mask in pairs]),
        np.concatenate([r.error_dps[mask] for r, mask in pairs]),
        np.concatenate([r.true_dps[mask] for r, mask in pairs]),
        np.concatenate(time),
        np.concatenate(block),
    )


def _lag(
    recordings: Sequence[Checked], masks: Sequence[np.ndarray], tau_s: float, rotating: bool
) -> np.ndarray:
    parts = []
    for item, mask in zip(recordings, masks, strict=True):
        temp = item.recording["temp_degC"]
        column = lagged(temp, item.recording["t_s"], tau_s) - temp
        parts.append(_times(column[mask], item.true_dps[mask], rotating))
    return np.concatenate(parts)


def _times(column: np.ndarray, rate: np.ndarray, rotating: bool) -> np.ndarray:
    """The column as bias and, where the gyro turned, as scale factor."""
    return np.column_stack([column, column * rate]) if rotating else column[:, None]


def _antecedents(found: TsFit, scaling: Scaling) -> Antecedents:
    return Antecedents(
        scaling.to_z(np.array(found.rules.centers)), np.array(found.rules.widths) / scaling.scale
    )


def _left(
    z: np.ndarray, antecedents: Antecedents, error: np.ndarray, extra: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Linear coefficients of rules and extra columns, and the residual [°/s]."""
    phi = regressors(np.ascontiguousarray(z), antecedents.centers, antecedents.widths, True)
    columns = phi if extra is None else np.hstack([phi, extra])
    scale = np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-300)
    theta = np.linalg.lstsq(columns / scale, error, rcond=1e-10)[0] / scale
    return theta, error - columns @ theta


def _with_lag(
    rows: _Rows,
    columns: np.ndarray,
    every: slice,
    scaling: Scaling,
    start: Antecedents,
    tau_s: float,
    names: Sequence[str],
    options: TsOptions,
) -> Model:
    antecedents = start
    if options.method == "gk-rls-refined":
        antecedents = refine(scaling.to_z(rows.inputs[every]), rows.error[every], start, columns[every])
    theta, left = _left(scaling.to_z(rows.inputs[every]), antecedents, rows.error[every], columns[every])
    count = columns.shape[1]
    rules = scaling.rules(antecedents, theta[:-count], True)
    parameters = {"tau_s": tau_s, "bias_dps_per_K": float(theta[-count])}
    if count > 1:
        parameters["scale_ppm_per_K"] = 1e6 * float(theta[-1])
    notes = [f"thermal lag of {tau_s:.0f} s fitted jointly with the rules"]
    found = TsFit(rules, None, options.method, float(np.std(left)), notes)
    return ts_model(found, names, rows.inputs, terms=[Term("thermal_lag", dict(parameters))])
