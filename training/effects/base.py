"""What an effect is: metadata for people and tools, and one method for the place where it acts.

A gyro's output is built in five stages; each has its own kind of effect:

    ErrorEffect    adds `error(truth, …)` [°/s] to the ideal output
    OutputEffect   maps the output itself (bandwidth, dead band, clipping, units, LSB)
    TimingEffect   delays it against the time stamp
    NoiseEffect    adds a random sequence
    FrameEffect    loses, freezes or wraps recorded rows
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType, SimpleNamespace
from typing import ClassVar

import numpy as np
from scipy.interpolate import CubicSpline

from rtcomp.errors import RequestError
from training.effects.truth import Truth

DRIVERS = (
    "temperature",
    "temperature_rate",
    "rate",
    "rate_times_temperature",
    "rate_times_temperature_rate",
    "angular_acceleration",
    "time",
    "rate_times_time",
    "time_since_power_on",
    "heading",
    "rate_times_heading",
    "speed",
    "acceleration",
    "vibration",
)
"""Every driver an effect or a finding may name (PHYSICS.md)."""

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Parameter:
    """One physical parameter: its unit, a nominal and a hard case, and how it enters the error.

    `linear` means that the error is proportional to it (all linear parameters scaled together scale the
    error); `default` is what an omitted parameter means, None where it must be given.
    """

    unit: str
    nominal: float
    hard: float
    linear: bool = False
    default: float | None = None


def amplitude(unit: str, nominal: float, hard: float, default: float | None = None) -> Parameter:
    """Give a parameter the error is proportional to."""
    return Parameter(unit, nominal, hard, linear=True, default=default)


def shape(unit: str, nominal: float, hard: float, default: float | None = None) -> Parameter:
    """Give a parameter that enters nonlinearly (time constant, play, period, knee)."""
    return Parameter(unit, nominal, hard, linear=False, default=default)


def parameters(**named: Parameter) -> Mapping[str, Parameter]:
    """Name an effect's parameters, read-only and in order."""
    return MappingProxyType(named)


class Effect(ABC):
    """One error source: its name, size and excitation; the docstring of each is its mechanism."""

    id: ClassVar[str]
    title: ClassVar[str]
    section: ClassVar[str]
    equation: ClassVar[str]
    parameters: ClassVar[Mapping[str, Parameter]]
    drivers: ClassVar[tuple[str, ...]]
    excitation: ClassVar[str]
    source: ClassVar[str]

    @property
    def mechanism(self) -> str:
        """The physical cause in one or two sentences."""
        return " ".join((self.__doc__ or "").split())

    def nominal(self) -> dict[str, float]:
        """Return the nominal parameters (PHYSICS.md §1 and §4.4)."""
        return {name: parameter.nominal for name, parameter in self.parameters.items()}

    def hard(self) -> dict[str, float]:
        """Return the hard case's parameters."""
        return {name: parameter.hard for name, parameter in self.parameters.items()}

    def complete(self, given: Mapping[str, float]) -> SimpleNamespace:
        """Check parameters and fill in the optional ones; RequestError names what is unknown or missing."""
        unknown = sorted(set(given) - set(self.parameters))
        needed = [name for name, parameter in self.parameters.items() if parameter.default is None]
        missing = [name for name in needed if name not in given]
        if unknown or missing:
            raise RequestError(
                f"effect {self.id}: unknown parameters {unknown}, missing {missing}; "
                f"it takes {list(self.parameters)}, of which {needed} must be given"
            )
        defaults = {name: parameter.default for name, parameter in self.parameters.items()}
        values = {name: float(value) for name, value in (defaults | dict(given)).items() if value is not None}
        bad = [name for name, value in values.items() if not np.isfinite(value)]
        if bad:
            raise RequestError(f"effect {self.id}: parameters {bad} are not finite; give a number")
        return SimpleNamespace(**values)


class ErrorEffect(Effect):
    """An effect that adds an error to the ideal output."""

    def error(self, truth: Truth, parameters: Mapping[str, float]) -> np.ndarray:
        """Return measured minus true rate [°/s] caused by this effect alone, shape `(n_samples,)`."""
        return np.broadcast_to(self._error(truth, self.complete(parameters)), truth.t_s.shape).copy()

    @abstractmethod
    def _error(self, truth: Truth, p: SimpleNamespace) -> np.ndarray | float: ...


class OutputEffect(Effect):
    """An effect that maps the output, whatever it is made of; `order` places it among its kind."""

    order: ClassVar[int]
    """Below 50: before the noise is added (optics, analog); above: after it (converter, firmware)."""

    def apply(self, output_dps: np.ndarray, truth: Truth, parameters: Mapping[str, float]) -> np.ndarray:
        """Return the altered output [°/s], shape `(n_samples,)`."""
        return self._apply(output_dps, truth, self.complete(parameters))

    def error(self, truth: Truth, parameters: Mapping[str, float]) -> np.ndarray:
        """Return the error [°/s] of an otherwise ideal gyro with this effect, shape `(n_samples,)`."""
        return self.apply(truth.rate_dps, truth, parameters) - truth.rate_dps

    @abstractmethod
    def _apply(self, output_dps: np.ndarray, truth: Truth, p: SimpleNamespace) -> np.ndarray: ...


class TimingEffect(Effect):
    """An effect that makes the output older than its time stamp says."""

    def delay_s(
        self, truth: Truth, parameters: Mapping[str, float], generator: np.random.Generator
    ) -> np.ndarray:
        """Return the age [s] of each stamped sample, shape `(n_samples,)`."""
        return np.broadcast_to(
            self._delay_s(truth, self.complete(parameters), generator), truth.t_s.shape
        ).copy()

    def error(self, truth: Truth, parameters: Mapping[str, float], seed: int = 0) -> np.ndarray:
        """Return the error [°/s] ω(t − τ) − ω(t) of an otherwise ideal gyro, shape `(n_samples,)`."""
        delay = self.delay_s(truth, parameters, np.random.default_rng(seed))
        return delayed(truth.t_s, truth.rate_dps, delay) - truth.rate_dps

    @abstractmethod
    def _delay_s(
        self, truth: Truth, p: SimpleNamespace, generator: np.random.Generator
    ) -> np.ndarray | float: ...


class NoiseEffect(Effect):
    """An effect that is a random sequence."""

    def sample(
        self, truth: Truth, parameters: Mapping[str, float], generator: np.random.Generator
    ) -> np.ndarray:
        """Draw the error [°/s], shape `(n_samples,)`."""
        return self._sample(truth, self.complete(parameters), generator)

    def error(self, truth: Truth, parameters: Mapping[str, float], seed: int = 0) -> np.ndarray:
        """Draw the error [°/s] of a stated seed, shape `(n_samples,)`."""
        return self.sample(truth, parameters, np.random.default_rng(seed))

    @abstractmethod
    def _sample(self, truth: Truth, p: SimpleNamespace, generator: np.random.Generator) -> np.ndarray: ...


class FrameEffect(Effect):
    """An effect on recorded rows; `order` places it among its kind."""

    order: ClassVar[int]

    def alter(
        self, columns: Columns, parameters: Mapping[str, float], generator: np.random.Generator
    ) -> Columns:
        """Return new columns with rows lost, frozen or re-stamped."""
        return self._alter(columns, self.complete(parameters), generator)

    @abstractmethod
    def _alter(self, columns: Columns, p: SimpleNamespace, generator: np.random.Generator) -> Columns: ...


def delayed(t_s: np.ndarray, values: np.ndarray, delay_s: np.ndarray) -> np.ndarray:
    """Return `values` at `t_s − delay_s` by a cubic spline, held outside, shape `(n_samples,)`.

    Not a Taylor series in the derivatives: 10 ms at 40 °/s² is 0.4 °/s, so the second order shows.
    """
    if t_s.size < 2 or not np.any(delay_s):
        return values.copy()
    if not np.all(np.diff(t_s) > 0.0):
        raise RequestError(
            "a delay needs time stamps that rise from row to row; sort the recording, drop doubles"
        )
    return CubicSpline(t_s, values)(np.clip(t_s - delay_s, t_s[0], t_s[-1]))
