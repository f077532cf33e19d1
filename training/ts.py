"""Takagi-Sugeno model, PAPER eqs. 1, 2, 9-11: GK antecedents, RLS consequents, and their joint refinement.

The fit runs on standardised inputs, so that units do not matter, and is stated in physical units: g = a0 + Σ a_k x_k.
Without the offset (as the paper prints φ) inputs are only scaled, since a shift would bring the offset back.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rtcomp.errors import RequestError
from rtcomp.model import Rules
from training.excitation import check_finite
from training.gk import Clustering, Outcome, Settings, cluster
from training.refine import Antecedents, refine
from training.regressors import regressors
from training.rls import RecursiveLeastSquares

log = logging.getLogger(__name__)
METHODS = ("gk-rls", "gk-rls-refined")
CHUNK = 65536  # rows of φ held at a time: memory does not grow with the recording
REFINE_ROWS = 20_000  # the refinement looks at no more rows than this; the consequents at all of them


@dataclass(frozen=True)
class TsOptions:
    """How to identify. `rls_start` is the paper's a, `offset` False is φ as printed."""

    method: str = "gk-rls-refined"
    rules: int = 4
    offset: bool = True
    rls_start: float = 1e6
    clustering: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        """Raises RequestError on a method that does not exist, or one that cannot do without the offset."""
        if self.method not in METHODS:
            raise RequestError(f"method {self.method!r}: give one of {', '.join(METHODS)}")
        if self.method == "gk-rls-refined" and not self.offset:
            raise RequestError(
                "φ without the offset is the paper's printed form: give it with --method gk-rls"
            )


@dataclass(frozen=True)
class TsFit:
    """Rules in physical units, how they came about, and the residual on the training rows."""

    rules: Rules
    clustering: Clustering | None  # None where it was refined away together with other terms
    method: str
    residual_std_dps: float
    notes: list[str]


@dataclass(frozen=True)
class Scaling:
    """x = z·scale + shift, per input."""

    shift: np.ndarray
    scale: np.ndarray

    def to_z(self, x: np.ndarray) -> np.ndarray:
        """Standardised inputs."""
        return (x - self.shift) / self.scale

    def rules(self, antecedents: Antecedents, theta: np.ndarray, offset: bool) -> Rules:
        """Rules in physical units."""
        c = len(antecedents.centers)
        slopes = theta.reshape(c, -1)[:, 1 if offset else 0 :] / self.scale
        constant = (theta.reshape(c, -1)[:, 0] if offset else np.zeros(c)) - slopes @ self.shift
        return Rules(
            centers=(antecedents.centers * self.scale + self.shift).tolist(),
            widths=(antecedents.widths * self.scale).tolist(),
            consequents=np.column_stack([constant, slopes]).tolist(),
        )


def fit(
    inputs: np.ndarray,
    error_dps: np.ndarray,
    names: Sequence[str],
    options: TsOptions | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> TsFit:
    """Identify rules from `inputs`, shape `(n_samples, n_inputs)`, and the gyro's output error, `(n_samples,)`.

    Raises RequestError naming the input that is not finite or lacks excitation, or on too few points.
    """
    options = options or TsOptions()
    inputs, error_dps = np.asarray(inputs, np.float64), np.asarray(error_dps, np.float64)
    check_rows(inputs, error_dps, names, options.rules)
    points = np.column_stack([inputs, error_dps])
    found = cluster(points, options.rules, options.clustering, [*names, "error_dps"], progress=progress)
    del points
    if found.outcome is Outcome.DEGENERATE:
        raise RequestError(f"degenerate: {found.sentence}")
    return _consequents(inputs, error_dps, found, options)


def check_rows(inputs: np.ndarray, error_dps: np.ndarray, names: Sequence[str], rules: int) -> None:
    """Refuse rows that are not finite, and fewer rows than parameters. Raises RequestError."""
    check_finite(np.column_stack([inputs[:1], error_dps[:1]]), [*names, "error_dps"])
    check_finite(inputs, names)
    check_finite(error_dps[:, None], ["error_dps"])
    parameters = rules * (3 * inputs.shape[1] + 1)
    if len(inputs) < parameters:
        raise RequestError(
            f"{len(inputs)} points for {parameters} parameters ({_rules(rules)}, {inputs.shape[1]} inputs): "
            "record more points or ask for fewer rules"
        )


def _rules(count: int) -> str:
    return f"{count} rule{'s' if count > 1 else ''}"


def _consequents(inputs: np.ndarray, error: np.ndarray, found: Clustering, options: TsOptions) -> TsFit:
    k = inputs.shape[1]
    scale = inputs.std(axis=0)
    scaling = Scaling(inputs.mean(axis=0) if options.offset else np.zeros(k), scale)
    antecedents = Antecedents(scaling.to_z(found.centers[:, :k]), found.widths[:, :k] / scale)
    notes = [] if found.outcome is Outcome.CONVERGED else [f"clustering: {found.sentence}"]
    if found.repaired:
        notes.append("clustering: the covariance repair acted (a cluster is flat)")
    if options.method == "gk-rls-refined":
        rows = _sample(len(inputs), options.clustering.seed, notes)
        antecedents = refine(scaling.to_z(inputs[rows]), error[rows], antecedents)
    theta, residual = recursive_consequents(inputs, error, scaling, antecedents, options)
    return TsFit(scaling.rules(antecedents, theta, options.offset), found, options.method, residual, notes)


def recursive_consequents(
    inputs: np.ndarray, error: np.ndarray, scaling: Scaling, antecedents: Antecedents, options: TsOptions
) -> tuple[np.ndarray, float]:
    """RLS over all rows in order, a chunk of φ at a time; θ and the residual standard deviation [°/s]."""
    c, k = antecedents.centers.shape
    estimator = RecursiveLeastSquares(c * (k + options.offset), options.rls_start)
    phi = np.empty((0, estimator.size))
    chunks = [slice(first, first + CHUNK) for first in range(0, len(inputs), CHUNK)]
    for rows in chunks:
        phi = _phi(inputs[rows], scaling, antecedents, options.offset)
        estimator.update(phi, error[rows])
    square = 0.0
    for rows in chunks:
        if len(chunks) > 1:  # more than one was too much to keep
            phi = _phi(inputs[rows], scaling, antecedents, options.offset)
        left = error[rows] - phi @ estimator.theta
        square += float(left @ left)
    return estimator.theta, float(np.sqrt(square / max(len(inputs) - estimator.size, 1)))


def _phi(inputs: np.ndarray, scaling: Scaling, antecedents: Antecedents, offset: bool) -> np.ndarray:
    z = np.ascontiguousarray(scaling.to_z(inputs))
    return regressors(z, antecedents.centers, antecedents.widths, offset)


def _sample(rows: int, seed: int, notes: list[str]) -> np.ndarray | slice:
    if rows <= REFINE_ROWS:
        return slice(None)
    notes.append(
        f"refinement: antecedents from {REFINE_ROWS} of {rows} rows drawn at random, consequents from all"
    )
    return np.sort(np.random.default_rng(seed).choice(rows, REFINE_ROWS, replace=False))


def choose_rules(
    inputs: np.ndarray,
    error_dps: np.ndarray,
    groups: np.ndarray,
    names: Sequence[str],
    options: TsOptions,
    candidates: Sequence[int] = (1, 2, 3, 4, 5, 6, 8),
    folds: int = 5,
) -> tuple[int, dict[int, float]]:
    """Number of rules by held-out score: whole `groups` (soaks, recordings, blocks) are left out in turn.

    The fewest rules whose held-out RMS is within one standard error of the best. Returns it and all scores [°/s].
    """
    fold = fold_of_groups(groups, folds, options.clustering.seed)
    scores: dict[int, tuple[float, float]] = {}
    refused: dict[int, RequestError] = {}
    for count in candidates:
        try:
            squares = _held_out_squares(inputs, error_dps, fold, names, replace(options, rules=count))
        except RequestError as reason:
            log.info("%d rules: %s", count, reason)
            refused[count] = reason
            continue
        scores[count] = (float(squares.mean()), float(squares.std(ddof=1) / np.sqrt(len(squares))))
    if not scores:
        reason = refused[min(refused)]
        raise RequestError(
            f"not even {_rules(min(refused))} can be fitted to a part of the recording: {reason}"
        )
    best = min(scores, key=lambda count: scores[count][0])
    limit = sum(scores[best])
    chosen = min(count for count in scores if scores[count][0] <= limit)
    return chosen, {count: float(np.sqrt(score[0])) for count, score in scores.items()}


def fold_of_groups(groups: np.ndarray, folds: int, seed: int) -> np.ndarray:
    """Fold index of every row; a group is never divided."""
    unique, index = np.unique(groups, return_inverse=True)
    if len(unique) < 2:
        raise RequestError(
            "one group only: nothing can be held out; give --rules, or record more than one soak"
        )
    return (np.random.default_rng(seed).permutation(len(unique)) % min(folds, len(unique)))[index]


def _held_out_squares(
    inputs: np.ndarray, error: np.ndarray, fold: np.ndarray, names: Sequence[str], options: TsOptions
) -> np.ndarray:
    """Mean squared held-out error per fold; RequestError when a fold cannot be fitted with that many rules."""
    squares = []
    for left_out in np.unique(fold):
        train = fold != left_out
        found = fit(inputs[train], error[train], names, options)
        left = error[~train] - rules_output(found.rules, inputs[~train])
        squares.append(np.mean(left**2))
    return np.array(squares)


def rules_output(rules: Rules, inputs: np.ndarray) -> np.ndarray:
    """TS output [°/s] of `rules` at `inputs`, shape `(n_samples, n_inputs)`, in physical units."""
    phi = regressors(np.ascontiguousarray(inputs), np.array(rules.centers), np.array(rules.widths), True)
    return phi @ np.array(rules.consequents).ravel()
