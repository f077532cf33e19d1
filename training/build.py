"""From identified rules to a model file."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rtcomp import __version__
from rtcomp.model import Model, new_model
from training.ts import TsFit

MARGIN = 0.1  # of the range: consequents are linear, and half a step beyond the last soak is no leap


def ts_model(found: TsFit, names: Sequence[str], inputs: np.ndarray, **fields: Any) -> Model:
    """A model of these rules, valid on the range of `inputs`, shape `(n_samples, n_inputs)`, and MARGIN beyond."""
    low, high = inputs.min(axis=0), inputs.max(axis=0)
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    stated: dict[str, Any] = {
        "inputs": list(names),
        "rules": found.rules,
        "validity": {name: (float(a), float(b)) for name, a, b in zip(names, low, high, strict=True)},
        "residual_std_dps": found.residual_std_dps,
        "provenance": provenance(method=found.method, samples=len(inputs), notes=found.notes),
    }
    return new_model(**(stated | fields))


def provenance(**facts: Any) -> dict[str, Any]:
    """What made a model."""
    return {"made_by": f"rtcomp {__version__}", **facts}
