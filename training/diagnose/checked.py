"""What the integrity checks hand on: repaired columns, who may vote, faults and remarks."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from training.diagnose.work import FloatArray


@dataclass
class Fault:
    """One integrity finding: the effect id, what was seen, how many samples, where, and its measured size."""

    effect: str
    text: str
    samples: int
    segments: list[tuple[float, float]] = field(default_factory=list)
    parameters: dict[str, tuple[float, str]] = field(default_factory=dict)


@dataclass
class Checked:
    """A recording after the checks: repaired columns, the mask of samples that may vote, faults and remarks.

    `rows` are the rows of the recording that the columns show, in their (repaired) order.
    """

    columns: dict[str, FloatArray]
    valid: NDArray[np.bool_]
    rows: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    faults: list[Fault] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    unusable: str | None = None
