"""Is there anything to identify? Refuses data whose inputs do not move, naming the input."""

from collections.abc import Sequence

import numpy as np

from rtcomp.errors import RequestError

CONSTANT = 1e-9  # range of a column over its magnitude, below which it carries rounding only
COLLINEAR = 1e-6  # smallest over largest singular value of the standardised inputs


def check_finite(points: np.ndarray, names: Sequence[str]) -> None:
    """Refuse rows that are not numbers.

    `points` has shape `(n_samples, n_columns)`. Raises RequestError naming column and row count.
    """
    bad = ~np.isfinite(points)
    if not bad.any():
        return
    counts = bad.sum(axis=0)
    worst = int(counts.argmax())
    first = int(bad[:, worst].argmax())
    raise RequestError(
        f"{names[worst]}: {counts[worst]} of {len(points)} rows are not finite numbers (first: row {first}); "
        "remove or repair them, or pass --drop-nan to leave those rows out"
    )


def lacking(inputs: np.ndarray, names: Sequence[str]) -> str | None:
    """Why `inputs`, shape `(n_samples, n_inputs)`, cannot be told apart; None when they can.

    Independent of units: a column counts as constant relative to its own magnitude.
    """
    low, high = inputs.min(axis=0), inputs.max(axis=0)
    magnitude = np.maximum(np.abs(low), np.abs(high))
    for k, name in enumerate(names):
        if high[k] - low[k] <= CONSTANT * magnitude[k]:
            return f"{name} is constant at {low[k]:g}: it excites nothing; record it over a range or leave it out"
    return _collinear(inputs, names)


def _collinear(inputs: np.ndarray, names: Sequence[str]) -> str | None:
    """Name the inputs that form a linear combination of each other."""
    if inputs.shape[1] < 2:
        return None
    correlation = np.corrcoef(inputs, rowvar=False)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    if eigenvalues[0] > COLLINEAR**2 * eigenvalues[-1] + 1e-13:
        return None
    share = np.abs(vectors[:, 0])
    involved = [name for name, part in zip(names, share, strict=True) if part > 0.1]
    return (
        f"{' and '.join(involved)} are collinear: they move only together; record them apart or leave one out"
    )
