"""Joint 95 % intervals of all parameters, linear and not, under a noise that was itself learnt from the residual."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from training.diagnose.design import Domain, band_gram
from training.diagnose.library import Parameters
from training.diagnose.likelihood import inverse
from training.diagnose.naming import Model, Part, movable, part_columns
from training.diagnose.spectrum import start, update
from training.diagnose.work import FloatArray

STEP = 0.02
EM_ROUNDS = 8
LEAST_FREEDOM = 3.0
SHAPE = 0.01  # of a parameter, one sigma: the catalogue's shapes are true to a percent, which a giant's noise hides not
SHARP = frozenset({"period_K", "phase_K", "chirp_per_K"})  # told by where they pass, not by a shape
WIDER = 1.15  # measured on planted truths: the smooth noise spectrum and the catalogue's shapes are approximations


@dataclass
class Estimates:
    """Joint estimates: names, values and covariance over all linear and non-linear parameters of the model."""

    names: list[tuple[int, int, str]]
    values: FloatArray
    covariance: FloatArray
    dof: FloatArray

    def interval(self, index: int) -> tuple[float, float]:
        """95 % interval of one parameter."""
        return self.along(np.eye(len(self.values))[index])

    def along(self, weights: FloatArray) -> tuple[float, float]:
        """95 % interval of a sum of parameters with weights `(n,)`, its freedom that of the least known of them."""
        middle = float(weights @ self.values)
        freedom = float(np.min(self.dof[weights != 0.0], initial=np.inf))
        spread = float(np.sqrt(max(weights @ self.covariance @ weights, 0.0)))
        shaped = np.array([name not in SHARP for _, _, name in self.names])
        of_shape = stats.norm.ppf(0.975) * SHAPE * float((weights * shaped) @ self.values)
        half = float(np.hypot(WIDER * stats.t.ppf(0.975, freedom) * spread, of_shape))
        return middle - half, middle + half


def restricted_spectrum(
    model: Model, domains: Sequence[Domain], derivatives: list[list[FloatArray]]
) -> FloatArray:
    """The noise spectrum with what the fitted columns took from it put back (restricted likelihood, by EM).

    A few columns can take most of the lowest bands; without this the slow noise comes out too small there and every
    interval of a slow effect with it.
    """
    pieces = []
    cuts = np.cumsum([len(d.edges) - 1 for d in domains])[:-1]
    for r, (d, bands) in enumerate(zip(domains, np.split(model.fit.spectrum, cuts), strict=True)):
        columns = np.concatenate(
            [d.nuisance, model.frame.chosen[r], *[dv[r][:, None] for dv in derivatives]], axis=1
        )
        left = (
            d.target
            - d.nuisance @ model.fit.nuisance[r][: d.nuisance.shape[1]]
            - model.frame.chosen[r] @ model.fit.beta
        )
        grams = band_gram(columns, columns, d.edges)
        power = np.add.reduceat(left**2, d.edges[:-1])
        counts = np.diff(d.edges).astype(float)
        phi, spectrum, weights = np.ascontiguousarray(d.phi), bands, None
        for _ in range(EM_ROUNDS):
            taken = np.einsum("bij,ji->b", grams, inverse(np.einsum("bij,b->ij", grams, 1.0 / spectrum)))
            powers = (power + taken) / counts
            weights = start(phi, counts, powers) if weights is None else weights
            spectrum = update(weights, phi, counts, powers, 60)
        pieces.append(spectrum)
    return np.concatenate(pieces)


def estimates(model: Model, domains: Sequence[Domain]) -> Estimates:
    """Gauss-Newton covariance: linear columns and the derivatives of the fit by every non-linear parameter."""
    names, values, derivatives = [], list(model.fit.beta), []
    for i, part in enumerate(model.parts):
        names += [(i, j, name) for j, point in enumerate(part.points) for name, _ in part.group.linear(point)]
    for i, (part, where) in enumerate(zip(model.parts, model.slices(), strict=True)):
        for j, point in enumerate(part.points):
            for name in movable(part.group, point):
                if np.isfinite(point[name]):
                    names.append((i, j, name))
                    values.append(point[name])
                    derivatives.append(_derivative(part, j, name, model.fit.beta[where], domains))
    spectrum = restricted_spectrum(model, domains, derivatives)
    white = _whitened(model, domains, derivatives, spectrum)
    covariance = inverse(sum_of(w.T @ w for w in white))
    return Estimates(names, np.asarray(values), covariance, _freedom(white, covariance, domains))


def sum_of(matrices: Iterable[FloatArray]) -> FloatArray:
    """Sum of equally shaped matrices."""
    return np.sum(np.stack(list(matrices)), axis=0)


def _freedom(white: list[FloatArray], covariance: FloatArray, domains: Sequence[Domain]) -> FloatArray:
    """Degrees of freedom of every estimate's error: how many noise coefficients its variance was learnt from.

    An estimate draws on bands with shares i_b of its information; a band's level is known from n_b coefficients, so
    the variance is known as well as a χ² with (Σ i_b)²/Σ(i_b²/n_b) degrees of freedom (Satterthwaite).
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    total, square = np.zeros(len(scale)), np.zeros(len(scale))
    for w, d in zip(white, domains, strict=True):
        direction = w @ covariance / scale
        share = np.add.reduceat(direction**2, d.edges[:-1], axis=0)
        total += share.sum(axis=0)
        square += np.sum(share**2 / np.diff(d.edges)[:, None], axis=0)
    used = len(scale)
    return np.clip(total**2 / np.maximum(square, 1e-300) - used, LEAST_FREEDOM, 1000.0)


def _derivative(
    part: Part, j: int, name: str, beta: FloatArray, domains: Sequence[Domain]
) -> list[FloatArray]:
    delta = 0.0005 if name == "chirp_per_K" else STEP * part.points[j][name] or STEP
    if name == "period_K":
        delta = 0.003 * part.points[j][name]
    sides = []
    for sign in (1.0, -1.0):
        points: list[Parameters] = [dict(p) for p in part.points]
        points[j][name] += sign * delta
        sides.append([part_columns(Part(part.group, points), d) @ beta for d in domains])
    return [(up - down) / (2.0 * delta) for up, down in zip(*sides, strict=True)]


def _whitened(
    model: Model, domains: Sequence[Domain], derivatives: list[list[FloatArray]], restricted: FloatArray
) -> list[FloatArray]:
    """Per recording the columns [linear | non-linear] whitened by the noise, nuisances projected out."""
    found = []
    cuts = np.cumsum([len(d.edges) - 1 for d in domains])[:-1]
    for r, (d, spectrum) in enumerate(zip(domains, np.split(restricted, cuts), strict=True)):
        columns = np.concatenate([model.frame.chosen[r], *[dv[r][:, None] for dv in derivatives]], axis=1)
        weight = 1.0 / np.sqrt(np.repeat(spectrum, np.diff(d.edges)))[:, None]
        nuisance, _ = np.linalg.qr(d.nuisance * weight)
        white = columns * weight
        found.append(white - nuisance @ (nuisance.T @ white))
    return found
