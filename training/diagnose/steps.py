"""Change points: the best instant of a step in bias or scale factor, found sample by sample.

A step has the spectrum of a random walk, so on a grid of instants the misplaced part of it looks like more noise.
With z = Σ⁻¹r (Σ the fitted noise, r the residual) the matched filter of every instant is a sum of z from there on:
one transform back and one cumulative sum give them all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from training.diagnose.design import Domain, Fit, Frame
from training.diagnose.library import Group, Parameters
from training.diagnose.work import FloatArray, inverse_dct

GRID = 24
EDGE = 0.015
FAINT = (
    0.01  # a step with less of the best one's norm stands where nothing moves: offset or scale factor again
)


@dataclass
class Stepper:
    """Step candidates of one group (bias or scale) over all recordings."""

    group: Group
    domains: Sequence[Domain]

    def __post_init__(self) -> None:
        """Transform a coarse grid of steps, for the matched filter's norm."""
        self.shares = np.linspace(EDGE, 1.0 - EDGE, GRID)
        self.rows = [self._grid(i) for i in range(len(self.domains))]

    def _grid(self, i: int) -> FloatArray:
        d = self.domains[i]
        columns = [
            self.group.columns(d.work, {"at_share": float(s), "recording": float(d.work.index)})[0]
            for s in self.shares
        ]
        return d.work.transform(np.stack(columns, axis=1))

    def best(self, frame: Frame, fit: Fit, column: int) -> tuple[Parameters, float] | None:
        """(parameters, 2 Δ log-likelihood) of the best instant in the frame's target `column`."""
        top: tuple[float, Parameters] | None = None
        cuts = np.cumsum([len(d.edges) - 1 for d in self.domains])[:-1]
        for i, (d, bands) in enumerate(zip(self.domains, np.split(fit.spectrum, cuts), strict=True)):
            spectrum = np.repeat(bands, np.diff(d.edges))
            coefficients = np.concatenate([fit.nuisance[i], fit.beta])
            left = frame.targets[i][:, column] - frame.base[i] @ coefficients
            power = self._power(i, left, spectrum)
            edge = max(2, int(EDGE * len(power)))
            power[:edge] = power[len(power) - edge :] = 0.0
            at = int(np.argmax(power))
            if top is None or power[at] > top[0]:
                top = (
                    float(power[at]),
                    {"at_share": (at + 1e-6) / len(power), "recording": float(d.work.index)},
                )
        if top is None:
            return None
        extra = [d.work.transform(np.stack(self.group.columns(d.work, top[1]), axis=1)) for d in self.domains]
        better = frame.fit(frame.grams(column, extra), fit.weights, rounds=4, inner=6)
        return top[1], 2.0 * (better.loglik - fit.loglik)

    def _norms(self, i: int, spectrum: FloatArray) -> FloatArray:
        """Whitened squared norm of the coarse grid's steps, nuisances projected out."""
        nuisance, rows = self.domains[i].nuisance, self.rows[i]
        weighted = nuisance / spectrum[:, None]
        cross = weighted.T @ rows
        own = np.einsum("ij,ij,i->j", rows, rows, 1.0 / spectrum)
        return own - np.sum(cross * (np.linalg.pinv(weighted.T @ nuisance) @ cross), axis=0)

    def _power(self, i: int, left: FloatArray, spectrum: FloatArray) -> FloatArray:
        """(matched filter)²/norm of a step at every sample."""
        d = self.domains[i]
        back = inverse_dct(left / spectrum) / d.work.spread
        shape = self.group.columns(d.work, {"at_share": 0.0, "recording": float(d.work.index)})[0]
        matched = np.cumsum((back * shape)[::-1])[::-1]
        norm = np.interp((np.arange(len(left)) + 0.5) / len(left), self.shares, self._norms(i, spectrum))
        seen = norm > FAINT * norm.max()
        return np.where(seen, matched**2 / np.maximum(norm, FAINT * norm.max() + 1e-300), 0.0)


def steppers(groups: Sequence[Group], domains: Sequence[Domain]) -> list[Stepper]:
    """The change-point searches these recordings allow."""
    if domains[0].work.points:
        return []
    return [Stepper(group, domains) for group in groups if group.effect in ("bias_step", "scale_step")]
