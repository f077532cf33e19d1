"""One comparison: least squares under a noise spectrum that is fitted along with it, from band Gram matrices.

Within a frequency band the noise is taken as level, so everything a fit needs of the data are the band's Gram
matrices A_b = [N X y]'[N X y] (N nuisance of this recording, X shared regressors).  The weighted normal equations are
Σ_b A_b/S_b, the residual power of band b is c'A_b c/n_b with c = (−ν, −β, 1), and Whittle's log-likelihood is
−½ Σ_b n_b (log S_b + P_b/S_b).  Noise and coefficients are improved in turn.  Both hypotheses of a comparison refit
the noise, so a slow effect has to beat "there is more slow noise" and not a noise model fixed beforehand.
"""

import numpy as np
from numpy.typing import NDArray

from rtcomp.jit import kernel
from training.diagnose.spectrum import update

COLLINEAR = 3e-6  # a column this much explained by those before it is left out: float32 carries no more
OUT = 1e150


@kernel
def _solve(matrix, right, n):
    """Solve the n×n symmetric system in place of `right` (Cholesky; collinear columns get a zero coefficient)."""
    scale = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / np.sqrt(matrix[i, i]) if matrix[i, i] > 0.0 else 0.0
    low = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            if i == j:
                low[i, i] = np.sqrt(total) if total > COLLINEAR else OUT
            else:
                low[i, j] = total / low[j, j]
    for col in range(right.shape[1]):
        for i in range(n):
            total = right[i, col] * scale[i]
            for k in range(i):
                total -= low[i, k] * right[k, col]
            right[i, col] = total / low[i, i]
        for i in range(n - 1, -1, -1):
            total = right[i, col]
            for k in range(i + 1, n):
                total -= low[k, i] * right[k, col]
            right[i, col] = total / low[i, i]
        for i in range(n):
            right[i, col] *= scale[i]
    return right


@kernel
def profile(grams, counts, firsts, phi, a, q, rounds, inner):
    """Fit coefficients and noise in turn.

    `grams` (bands, m, m) over columns [q nuisance | p shared | y]; `firsts` (recordings + 1) band ranges;
    `phi` (shapes, bands); `a` (recordings, shapes) start weights, improved in place.
    Returns (log-likelihood, beta (p,), information (p, p), nuisance (recordings, q), powers (bands,), S (bands,)).
    """
    n_bands, m, _ = grams.shape
    p = m - q - 1
    n_rec = len(firsts) - 1
    spectrum = np.empty(n_bands)
    powers = np.empty(n_bands)
    beta = np.zeros(p)
    information = np.zeros((p, p))
    nuisance = np.zeros((n_rec, q))
    back = np.zeros((n_rec, q, p + 1))
    c = np.empty(m)
    for r in range(n_rec):
        part = slice(firsts[r], firsts[r + 1])
        spectrum[part] = update(a[r], phi[:, part], counts[part], counts[part], 0)
    for _ in range(rounds):
        schur = np.zeros((p, p + 1))
        for r in range(n_rec):
            normal = np.zeros((m, m))
            for b in range(firsts[r], firsts[r + 1]):
                weight = 1.0 / spectrum[b]
                for i in range(m):
                    for j in range(i + 1):
                        normal[i, j] += weight * grams[b, i, j]
            for i in range(m):
                for j in range(i):
                    normal[j, i] = normal[i, j]
            solved = _solve(normal[:q, :q], normal[:q, q:].copy(), q)
            back[r] = solved
            for i in range(p):
                for j in range(p + 1):
                    total = normal[q + i, q + j]
                    for k in range(q):
                        total -= normal[k, q + i] * solved[k, j]
                    schur[i, j] += total
        information[:, :] = schur[:, :p]
        if p > 0:
            beta[:] = _solve(schur[:, :p].copy(), schur[:, p:].copy(), p)[:, 0]
        for r in range(n_rec):
            for k in range(q):
                total = back[r, k, p]
                for i in range(p):
                    total -= back[r, k, i] * beta[i]
                nuisance[r, k] = total
                c[k] = -total
            for i in range(p):
                c[q + i] = -beta[i]
            c[m - 1] = 1.0
            for b in range(firsts[r], firsts[r + 1]):
                total = 0.0
                for i in range(m):
                    row = 0.5 * grams[b, i, i] * c[i]
                    for j in range(i):
                        row += grams[b, i, j] * c[j]
                    total += 2.0 * c[i] * row
                powers[b] = max(total, 1e-12 * grams[b, m - 1, m - 1]) / counts[b]
            part = slice(firsts[r], firsts[r + 1])
            spectrum[part] = update(a[r], phi[:, part], counts[part], powers[part], inner)
    loglik = 0.0
    for b in range(n_bands):
        loglik -= 0.5 * counts[b] * (np.log(spectrum[b]) + powers[b] / spectrum[b])
    return loglik, beta, information, nuisance, powers, spectrum


def inverse(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pseudo-inverse of an information matrix whose parameters have units of very different size."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale[:, None] * scale[None, :]
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-10, hermitian=True)) * scale[:, None] * scale[None, :]
