"""What a plantable effect is: how its parameters are drawn, what it does to the signal, what can be known of it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tools.blind.scenes import Scene

Parameters = dict[str, Any]
Draw = Callable[[np.random.Generator, Scene], Parameters]
Apply = Callable[[np.ndarray, Scene, Parameters], np.ndarray]
STAGES = ("motion", "optics", "electronics", "code", "reference", "frames")
"""In the order of the signal; `reference` acts on the reference, `frames` on the finished recording."""


@dataclass(frozen=True)
class Known:
    """A true parameter with a definition of its own: `exact` where an interval may be asked to cover it."""

    value: float
    exact: bool = True
    magnitude: bool = False


def no_truth(scene: Scene, parameters: Parameters) -> dict[str, Known]:
    """For effects whose parameters have no definition outside the generator."""
    return {}


def no_draw(rng: np.random.Generator, scene: Scene) -> Parameters:
    """For effects that have a strength only."""
    return {}


@dataclass(frozen=True)
class Effect:
    """One error source.

    Attributes:
        id: the catalogue's name, or a name of the generator's own for what no catalogue has.
        drivers: ids of drivers that count as the right answer.
        stage: one of STAGES.
        kinds: kinds of scene that excite it.
        draw: shape parameters, given the training scene; `strength` is set by the planner.
        apply: the signal [°/s] with the effect, from the signal without; frames-stage effects have none.
        unit: a strength to start from; where `linear`, the waveform is proportional to it.
        linear: whether one evaluation suffices to reach a wanted d′.
        transferable: whether a held-out recording carries the same, predictable effect.
        delay_is_point: whether a free delay would explain it away.
        variance: for effects on the variance: added variance per sample [(°/s)²].
        truth: the parameters that a diagnosis can be compared with.
        limit: largest meaningful strength.
        fixed: draws the strength where a wanted d′ makes no sense.
    """

    id: str
    drivers: tuple[str, ...]
    stage: str
    kinds: tuple[str, ...]
    draw: Draw = no_draw
    apply: Apply | None = None
    unit: float = 1.0
    linear: bool = True
    transferable: bool = True
    delay_is_point: bool = False
    variance: Callable[[Scene, Parameters], np.ndarray] | None = None
    truth: Callable[[Scene, Parameters], dict[str, Known]] = no_truth
    limit: float = np.inf
    fixed: Callable[[np.random.Generator, Scene], float] | None = None


@dataclass
class Planted:
    """An effect with its parameters in a case."""

    effect: Effect
    parameters: Parameters = field(default_factory=dict)

    @property
    def id(self) -> str:
        """The effect's name."""
        return self.effect.id
