"""Columns of all recordings in the whitening domain, ready to be compared in any combination."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rtcomp.jit import kernel
from training.diagnose.library import Group, Parameters
from training.diagnose.likelihood import profile
from training.diagnose.spectrum import start
from training.diagnose.work import FloatArray, Work

ROUNDS, INNER = 4, 6
THREADS = 2
FINALISTS = 6
COLUMN_PRICE = 3.0  # as EXTRA_COLUMN of the search; here it only orders variants of one group


@dataclass(frozen=True)
class Variant:
    """One point of a group's grid: its non-linear parameters and where its columns lie."""

    group: Group
    parameters: Parameters
    first: int
    width: int


@dataclass
class Domain:
    """One recording in the whitening domain: `nuisance` (n, q), `target` (n,), bands and noise shapes."""

    work: Work
    nuisance: FloatArray
    target: FloatArray
    edges: NDArray[np.int64]
    phi: FloatArray


@dataclass
class Fit:
    """Result of one joint fit: shared coefficients with their information matrix, noise, band powers."""

    loglik: float
    beta: FloatArray
    information: FloatArray
    nuisance: FloatArray
    weights: FloatArray
    spectrum: FloatArray


def domain(work: Work, extra: Sequence[FloatArray] = ()) -> Domain:
    """Transform a recording: nuisances are its offset, its scale factor and `extra` columns."""
    columns = [np.ones(len(work)), *([work.w] if np.ptp(work.w) > 0 else []), *extra]
    stack = work.transform(np.stack([*columns, work.y], axis=1))
    stack[:, :-1] /= np.sqrt(np.sum(stack[:, :-1] ** 2, axis=0)) + 1e-300
    return Domain(work, stack[:, :-1], stack[:, -1], work.bands(), work.noise_shapes())


def band_gram(left: FloatArray, right: FloatArray, edges: NDArray[np.int64]) -> FloatArray:
    """left_b' right_b for every band, shape `(bands, left columns, right columns)`."""
    parts = [left[a:b].T @ right[a:b] for a, b in pairwise(edges)]
    return np.asarray(parts, dtype=np.float64)


class Frame:
    """Nuisances, chosen shared columns and targets of all recordings, with their Gram matrices."""

    def __init__(
        self, domains: Sequence[Domain], chosen: Sequence[FloatArray] = (), targets: Sequence[FloatArray] = ()
    ):
        self.domains = list(domains)
        self.q = max(d.nuisance.shape[1] for d in domains)
        self.chosen = list(chosen) or [np.empty((len(d.target), 0)) for d in domains]
        self.targets = list(targets) or [d.target[:, None] for d in domains]
        self.counts = np.concatenate([np.diff(d.edges).astype(float) for d in domains])
        sizes = [len(d.edges) - 1 for d in domains]
        self.firsts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self.phi = np.concatenate([d.phi for d in domains], axis=1)
        self.base = [self._left(i) for i in range(len(domains))]

    def _left(self, i: int) -> FloatArray:
        d = self.domains[i]
        pad = np.zeros((len(d.target), self.q - d.nuisance.shape[1]))
        return np.concatenate([d.nuisance, pad, self.chosen[i]], axis=1)

    def grams(self, column: int = 0, extra: Sequence[FloatArray] | None = None) -> FloatArray:
        """Band Gram matrices over [nuisance | chosen | extra | target `column`]."""
        parts = []
        for i, d in enumerate(self.domains):
            right = [self.base[i], self.targets[i][:, column : column + 1]]
            if extra is not None:
                right.insert(1, extra[i])
            stack = np.concatenate(right, axis=1)
            parts.append(band_gram(stack, stack, d.edges))
        return np.concatenate(parts)

    def first_weights(self, grams: FloatArray) -> FloatArray:
        """Noise weights from the raw band powers of the target."""
        powers = np.maximum(grams[:, -1, -1] / self.counts, 1e-300)
        parts = [slice(a, b) for a, b in zip(self.firsts[:-1], self.firsts[1:], strict=True)]
        return np.asarray(
            [start(np.ascontiguousarray(self.phi[:, s]), self.counts[s], powers[s]) for s in parts]
        )

    def best_fit(self, grams: FloatArray, weights: FloatArray) -> Fit:
        """The better of two fits: from known noise weights, and afresh, as a shape they have at nothing stays there."""
        return max(self.fit(grams), self.fit(grams, weights), key=lambda fit: fit.loglik)

    def fit(
        self, grams: FloatArray, weights: FloatArray | None = None, rounds: int = 12, inner: int = 25
    ) -> Fit:
        """Joint fit of coefficients and noise on these Gram matrices."""
        a = self.first_weights(grams) if weights is None else weights.copy()
        loglik, beta, information, nuisance, _, spectrum = profile(
            grams, self.counts, self.firsts, self.phi, a, self.q, rounds, inner
        )
        return Fit(loglik, beta, information, nuisance, a, spectrum)


@kernel
def own_grams(rows, edges, firsts, widths, places, out):
    """X_b'X_b of every variant, its width² numbers from `places` on, in `out` `(bands, sum of width²)`."""
    for b in range(len(edges) - 1):
        for v in range(len(firsts)):
            f, k, at = firsts[v], widths[v], places[v]
            for i in range(k):
                for j in range(i + 1):
                    total = 0.0
                    for row in range(edges[b], edges[b + 1]):
                        total += rows[f + i, row] * rows[f + j, row]
                    out[b, at + i * k + j] = total
                    out[b, at + j * k + i] = total


@kernel
def scan_these(
    base, cross, own, target, counts, firsts, phi, a, q, widths, starts, places, rounds, inner, variants, out
):
    """Log-likelihood of [nuisance | chosen | variant] for the listed variants, put at their places in `out`.

    `base` (bands, k+1, k+1) over [nuisance | chosen | target]; `cross` (bands, M, k) library × [nuisance | chosen];
    `target` (bands, M) library × target; `own` the variants' Grams from `places` on.
    """
    n_bands, k, _ = base.shape
    k -= 1
    for v in variants:
        p = widths[v]
        m = k + p + 1
        grams = np.empty((n_bands, m, m))
        for b in range(n_bands):
            for i in range(k):
                for j in range(k):
                    grams[b, i, j] = base[b, i, j]
                grams[b, i, m - 1] = base[b, i, k]
                grams[b, m - 1, i] = base[b, k, i]
            grams[b, m - 1, m - 1] = base[b, k, k]
            for c in range(p):
                for i in range(k):
                    grams[b, k + c, i] = cross[b, starts[v] + c, i]
                    grams[b, i, k + c] = cross[b, starts[v] + c, i]
                grams[b, k + c, m - 1] = target[b, starts[v] + c]
                grams[b, m - 1, k + c] = target[b, starts[v] + c]
                for d in range(p):
                    grams[b, k + c, k + d] = own[b, places[v] + c * p + d]
        out[v] = profile(grams, counts, firsts, phi, a.copy(), q, rounds, inner)[0]


class Library:
    """All variants of all groups in the whitening domain (float32, one row per column)."""

    def __init__(self, domains: Sequence[Domain], groups: Sequence[Group], survey: object):
        self.domains = list(domains)
        self.groups = list(groups)
        self.variants = _variants(groups, survey)
        self.starts = np.asarray([v.first for v in self.variants], dtype=np.int64)
        self.widths = np.asarray([v.width for v in self.variants], dtype=np.int64)
        self.places = np.cumsum(self.widths**2) - self.widths**2
        effects = [v.group.effect for v in self.variants]
        self.members = [np.flatnonzero([e == name for e in effects]) for name in dict.fromkeys(effects)]
        with ThreadPoolExecutor(THREADS) as pool:
            self.rows = list(pool.map(self._transform, self.domains))
        self.own = np.concatenate([self._own(i) for i in range(len(self.domains))])

    def _transform(self, d: Domain) -> NDArray[np.float32]:
        rows = np.empty((int(self.widths.sum()), len(d.work)), dtype=np.float32)
        for v in self.variants:
            columns = np.stack(v.group.columns(d.work, v.parameters), axis=1)
            rows[v.first : v.first + v.width] = d.work.transform(columns.astype(np.float32)).T
        return rows

    def _own(self, i: int) -> FloatArray:
        edges = self.domains[i].edges
        out = np.zeros((len(edges) - 1, int(np.sum(self.widths**2))))
        own_grams(self.rows[i], edges, self.starts, self.widths, self.places, out)
        return out

    def cross(self, right: Sequence[FloatArray]) -> FloatArray:
        """Library × `right` per band, all recordings stacked: `(bands, M, columns)`."""
        parts = []
        for i, d in enumerate(self.domains):
            columns = right[i].astype(np.float32)
            parts += [
                self.rows[i][:, a:b] @ columns[a:b] for a, b in zip(d.edges[:-1], d.edges[1:], strict=True)
            ]
        return np.asarray(parts, dtype=np.float64)

    def scan(self, frame: Frame, fit: Fit, column: int, cross: FloatArray, target: FloatArray) -> FloatArray:
        """Log-likelihood of every variant added to the frame, starting from the noise of `fit`."""
        base = frame.grams(column)
        out = np.full(len(self.variants), -np.inf)
        chosen = self._promising(self._quick_gains(frame, fit, base, cross, target))
        arguments = (
            base,
            cross,
            self.own,
            np.ascontiguousarray(target),
            frame.counts,
            frame.firsts,
            frame.phi,
        )

        def run(part: NDArray[np.int64]) -> None:
            scan_these(
                *arguments,
                fit.weights,
                frame.q,
                self.widths,
                self.starts,
                self.places,
                ROUNDS,
                INNER,
                part,
                out,
            )

        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(run, np.array_split(chosen, 2 * THREADS)))
        return out

    def _quick_gains(
        self, frame: Frame, fit: Fit, base: FloatArray, cross: FloatArray, target: FloatArray
    ) -> FloatArray:
        """2 Δ log-likelihood of every variant under the noise of `fit`, not refitted: a weighted sum over bands each.

        Arrays as for `scan_these`.  Nuisances are projected out per recording, chosen columns over all of them.
        """
        q, k = frame.q, base.shape[1] - 1
        sums = []
        for low, high in pairwise(frame.firsts):
            weight = 1.0 / fit.spectrum[low:high]
            sums.append([np.tensordot(weight, part[low:high], 1) for part in (base, cross, self.own, target)])
        gains = np.empty(len(self.variants))
        for width in np.unique(self.widths):
            members = np.flatnonzero(self.widths == width)
            rows = self.starts[members][:, None] + np.arange(width)
            squares = self.places[members][:, None] + np.arange(width**2)
            matrix, right = _projected(sums, rows, squares, q, k)
            scale = 1.0 / np.sqrt(np.maximum(np.einsum("vii->vi", matrix), 1e-200))
            matrix = matrix * scale[:, :, None] * scale[:, None, :] + 1e-6 * np.eye(width)
            right = right * scale
            gains[members] = np.sum(right * np.linalg.solve(matrix, right[..., None])[..., 0], axis=1)
        return gains

    def _promising(self, quick: FloatArray) -> NDArray[np.int64]:
        """Indices of the `FINALISTS` best variants of every group, by their gain under the noise as it is."""
        value = quick - COLUMN_PRICE * self.widths
        best = [np.asarray(members)[np.argsort(-value[members])[:FINALISTS]] for members in self.members]
        return np.concatenate(best)


def _projected(
    sums: Sequence[Sequence[FloatArray]], rows: NDArray[np.int64], squares: NDArray[np.int64], q: int, k: int
) -> tuple[FloatArray, FloatArray]:
    """Normal equations of variants of one width: (matrices, right sides), nuisance and chosen columns projected out."""
    count, width = rows.shape
    matrix, right = np.zeros((count, width, width)), np.zeros((count, width))
    bridge, shared, ahead = np.zeros((count, width, k - q)), np.zeros((k - q, k - q)), np.zeros(k - q)
    for normal, across, own, target in sums:
        inverse = np.linalg.pinv(normal[:q, :q], rcond=1e-12, hermitian=True)
        here = across[rows]
        nuisance = here[..., :q] @ inverse
        matrix += own[squares].reshape(count, width, width) - nuisance @ here[..., :q].swapaxes(1, 2)
        right += target[rows] - nuisance @ normal[:q, k]
        bridge += here[..., q:] - nuisance @ normal[:q, q:k]
        shared += normal[q:k, q:k] - normal[q:k, :q] @ inverse @ normal[:q, q:k]
        ahead += normal[q:k, k] - normal[q:k, :q] @ inverse @ normal[:q, k]
    solved = bridge @ np.linalg.pinv(shared, rcond=1e-12, hermitian=True)
    return matrix - solved @ bridge.swapaxes(1, 2), right - solved @ ahead


def _variants(groups: Sequence[Group], survey: object) -> list[Variant]:
    variants, first = [], 0
    for group in groups:
        for parameters in group.grid(survey):  # type: ignore[arg-type]
            width = len(group.linear(parameters))
            variants.append(Variant(group, parameters, first, width))
            first += width
    return variants
