"""Noise spectra: a non-negative sum of physical shapes, fitted by Whittle likelihood inside every comparison.

A residual that is pure gyro noise has independent DCT coefficients whose variance follows the power spectrum.  The
spectrum is written as S(u) = Σ_j a_j φ_j(u), a_j ≥ 0, with u = 2 sin(πk/2n) the frequency of coefficient k:
white (angle random walk), 1/u (bias instability), 1/u² (rate random walk), u² (quantised angle increments) and a
ladder of Lorentzians 1/(u² + c²), the spectra of Ornstein-Uhlenbeck and telegraph noise.  Nothing is assumed about
which of them is there, because a recording's noise need not be the textbook's.

The fit is the multiplicative update of Itakura-Saito divergence (Févotte & Idier 2011), which is Whittle's
likelihood for band powers, keeps every a_j ≥ 0 and needs no derivative.
"""

import numpy as np
from numpy.typing import NDArray

from rtcomp.jit import kernel

FloatArray = NDArray[np.float64]
SINGLE_BINS = 12
BAND_RATIO = 1.15
LORENTZIANS = 7
SHAPES = ("white", "flicker", "random_walk", "rising", *(f"relaxation_{i}" for i in range(LORENTZIANS)))


def band_edges(n: int) -> NDArray[np.int64]:
    """Edges of the frequency bands over DCT coefficients 0..n−1: single ones first, then 15 % wide."""
    edges = list(range(min(SINGLE_BINS, n) + 1))
    while edges[-1] < n:
        edges.append(min(n, max(edges[-1] + 1, int(edges[-1] * BAND_RATIO))))
    return np.asarray(edges, dtype=np.int64)


def band_frequencies(edges: NDArray[np.int64], n: int) -> FloatArray:
    """u = 2 sin(πk/2n) at the geometric middle of each band; the mean (k = 0) is given half a step."""
    low, high = np.maximum(edges[:-1], 0.5), np.maximum(edges[1:] - 1.0, 0.5)
    return 2.0 * np.sin(0.5 * np.pi * np.sqrt(low * high) / n)


def shapes(u: FloatArray, n: int) -> FloatArray:
    """φ_j(u), shape `(len(SHAPES), len(u))`, each scaled to at most 1."""
    corners = np.geomspace(np.pi / n * 4.0, 0.7, LORENTZIANS)
    rows = [np.ones_like(u), 1.0 / u, 1.0 / u**2, u**2]
    rows += [1.0 / (u**2 + corner**2) for corner in corners]
    phi = np.asarray(rows)
    return phi / phi.max(axis=1, keepdims=True)


@kernel
def update(a, phi, counts, powers, rounds):
    """Improve the weights `a` in place: `rounds` multiplicative updates towards band powers; returns S per band."""
    n_shapes, n_bands = phi.shape
    spectrum = np.zeros(n_bands)
    for _ in range(rounds + 1):
        for b in range(n_bands):
            total = 1e-300
            for j in range(n_shapes):
                total += a[j] * phi[j, b]
            spectrum[b] = total
        if _ == rounds:
            break
        for j in range(n_shapes):
            if a[j] <= 0.0:
                continue
            top, bottom = 0.0, 0.0
            for b in range(n_bands):
                weight = counts[b] * phi[j, b] / spectrum[b]
                top += weight * powers[b] / spectrum[b]
                bottom += weight
            a[j] *= top / bottom
    return spectrum


@kernel
def start(phi, counts, powers):
    """First weights: every shape gets an equal share of what the band powers allow it."""
    n_shapes, n_bands = phi.shape
    a = np.empty(n_shapes)
    for j in range(n_shapes):
        top, bottom = 0.0, 0.0
        for b in range(n_bands):
            if powers[b] > 0.0:
                top += counts[b] * phi[j, b] / powers[b]
                bottom += counts[b] * (phi[j, b] / powers[b]) ** 2
        a[j] = top / bottom / n_shapes if bottom > 0.0 else 0.0
    return a
