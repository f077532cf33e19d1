"""Compiled Gustafson-Kessel iterations over standardised points, PAPER eqs. 3-8.

Points `z` have shape (columns, samples) and the partition `mu` (clusters, samples), as in the paper: the inner loops
then run along contiguous rows, which the compiler turns into vector instructions. Work goes in blocks of samples
that stay in the cache.
"""

import numpy as np

from rtcomp.jit import kernel, sum_kernel

BLOCK = 2048


@kernel
def iterate(z, mu, m, tolerance, steps, max_ratio, shrinkage, spread, objective):
    """Up to `steps` rounds of eqs. 7, 5, 4, 6, `mu` in place, until its largest change is below `tolerance`.

    Returns (rounds done, last change, whether the repair acted, centres, covariances); `objective` takes J (eq. 3).
    """
    n, clusters = z.shape[0], mu.shape[0]
    centers = np.zeros((clusters, n))
    covariances = np.empty((clusters, n, n))
    norms = np.empty((clusters, n, n))
    repaired, change, done = False, np.inf, 0
    while done < steps and change >= tolerance:
        weighted_moments(z, mu, m, centers, covariances)
        for j in range(clusters):
            repaired |= norm_matrix(covariances[j], max_ratio, shrinkage, spread, norms[j])
        change, objective[done] = update_partition(z, mu, centers, norms, m)
        done += 1
    return done, change, repaired, centers, covariances


@kernel
def powered(mu, m, out):
    """`out` = μ^m."""
    if m == 2.0:
        for i in range(len(mu)):
            out[i] = mu[i] * mu[i]
    else:
        for i in range(len(mu)):
            out[i] = mu[i] ** m


@sum_kernel
def total_of(a):
    """Σ a_i."""
    total = 0.0
    for i in range(len(a)):
        total += a[i]
    return total


@sum_kernel
def product_of(a, b):
    """Σ a_i b_i."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel
def largest_of(a):
    """Largest of numbers of which none is negative: their bits, taken as integers, are in the same order."""
    largest = np.int64(0)
    for i in range(len(a)):
        largest = max(largest, np.float64(a[i]).view(np.int64))
    return np.int64(largest).view(np.float64)


@kernel
def weighted_moments(z, mu, m, centers, covariances):
    """v_j = Σ_i μ_ji^m z_i / Σ_i μ_ji^m (eq. 7) and F_j = Σ_i μ_ji^m (z_i − v_j)(z_i − v_j)ᵀ / Σ_i μ_ji^m (eq. 5).

    One pass for both: sums are taken about the centres that `centers` brings, and moved to the new ones,
    F = Σ μ^m (z − v₀)(z − v₀)ᵀ / Σ μ^m − (v − v₀)(v − v₀)ᵀ; as the partition settles v − v₀ goes to 0.
    """
    n, samples = z.shape
    size = min(BLOCK, samples)
    weights, weighted, apart, moved = np.empty(size), np.empty(size), np.empty((n, size)), np.empty(n)
    for j in range(mu.shape[0]):
        total = 0.0
        moved[:] = 0.0
        covariances[j] = 0.0
        for first in range(0, samples, BLOCK):
            last = min(first + BLOCK, samples)
            b = last - first
            w, part = weights[:b], weighted[:b]
            powered(mu[j, first:last], m, w)
            total += total_of(w)
            for k in range(n):
                row, source, v = apart[k], z[k, first:last], centers[j, k]
                for i in range(b):
                    row[i] = source[i] - v
                    part[i] = w[i] * row[i]
                moved[k] += total_of(part)
                for h in range(k + 1):
                    covariances[j, k, h] += product_of(part, apart[h, :b])
        for k in range(n):
            moved[k] /= total
            centers[j, k] += moved[k]
            for h in range(k + 1):
                covariances[j, k, h] = covariances[j, k, h] / total - moved[k] * moved[h]
                covariances[j, h, k] = covariances[j, k, h]


@kernel
def norm_matrix(covariance, max_ratio, shrinkage, spread, out):
    """A = (det F)^(1/n) F⁻¹ (eq. 4 with ρ = 1) into `out`; True when the repair of Babuška (2002) acted.

    Eigenvalues are looked at only where their ratio could reach β: λ_max ≤ tr F and
    λ_min ≥ det F·((n − 1)/tr F)^(n−1).
    """
    n = len(covariance)
    if shrinkage == 0.0:
        trace, determinant = 0.0, inverse_of(covariance, out)
        for k in range(n):
            trace += covariance[k, k]
        if determinant > 0.0 and trace * (trace / max(n - 1, 1)) ** (n - 1) < max_ratio * determinant:
            volume = determinant ** (1.0 / n)
            for k in range(n):
                for h in range(n):
                    out[k, h] *= volume
            return False
    return repaired_norm_matrix(covariance, max_ratio, shrinkage, spread, out)


@kernel
def inverse_of(covariance, out):
    """Inverse of a symmetric positive definite matrix by Gauss-Jordan; returns its determinant, 0 when singular."""
    n = len(covariance)
    left = covariance.copy()
    out[:] = 0.0
    determinant = 1.0
    for k in range(n):
        out[k, k] = 1.0
    for k in range(n):
        pivot = left[k, k]
        if not pivot > 0.0:
            return 0.0
        determinant *= pivot
        for h in range(n):
            left[k, h] /= pivot
            out[k, h] /= pivot
        for q in range(n):
            if q != k:
                factor = left[q, k]
                for h in range(n):
                    left[q, h] -= factor * left[k, h]
                    out[q, h] -= factor * out[k, h]
    return determinant


@kernel
def repaired_norm_matrix(covariance, max_ratio, shrinkage, spread, out):
    """F ← (1−γ)F + γ·spread·I, then eigenvalues below λ_max/β are raised to it; A of that into `out`."""
    n = len(covariance)
    mended = (1.0 - shrinkage) * covariance + shrinkage * spread * np.eye(n)
    values, vectors = np.linalg.eigh(mended)
    floor = max(values[n - 1] / max_ratio, 1e-300)
    repaired, volume = shrinkage > 0.0, 0.0
    for k in range(n):
        if values[k] < floor:
            values[k] = floor
            repaired = True
        volume += np.log(values[k]) / n
    volume = np.exp(volume)
    for k in range(n):
        for h in range(n):
            total = 0.0
            for q in range(n):
                total += vectors[k, q] * vectors[h, q] / values[q]
            out[k, h] = volume * total
    return repaired


@kernel
def update_partition(z, mu, centers, norms, m):
    """Distances (eq. 4) and memberships (eq. 6) in place; largest change of μ, and J (eq. 3)."""
    n, samples = z.shape
    clusters = mu.shape[0]
    size = min(BLOCK, samples)
    square, inverse, share = np.empty((clusters, size)), np.empty((clusters, size)), np.empty(size)
    change, objective = 0.0, 0.0
    apart = np.empty((n, size))
    for first in range(0, samples, BLOCK):
        last = min(first + BLOCK, samples)
        b = last - first
        distances(z, first, last, centers, norms, square, apart)
        objective += inverse_powers(square, b, m, inverse, share)
        for j in range(clusters):
            old, q, moved = (
                mu[j, first:last],
                inverse[j, :b],
                square[j, :b],
            )  # distances are not needed any more
            for i in range(b):
                q[i] *= share[i]
                moved[i] = abs(q[i] - old[i])
            for i in range(b):
                old[i] = q[i]
            change = max(change, largest_of(moved))
    return change, objective


@kernel
def distances(z, first, last, centers, norms, square, apart):
    """D²_ji = (z_i − v_j)ᵀ A_j (z_i − v_j) (eq. 4) of samples `first` to `last`, into the first places of `square`.

    `apart` is scratch, shape (columns, samples). Rows are cut here, for only then is it known that they have no gaps.
    """
    n, b = z.shape[0], last - first
    for j in range(len(centers)):
        d = square[j, :b]
        d[:] = 0.0
        for k in range(n):
            row, source, v = apart[k, :b], z[k, first:last], centers[j, k]
            a = norms[j, k, k]
            for i in range(b):
                row[i] = source[i] - v
                d[i] += a * row[i] * row[i]
            for h in range(k):
                other, twice = apart[h, :b], 2.0 * norms[j, k, h]
                for i in range(b):
                    d[i] += twice * row[i] * other[i]


@sum_kernel
def inverse_powers(square, samples, m, inverse, share):
    """`inverse` = (1/D²)^(1/(m−1)), `share` = 1/Σ_j of it, so that μ = inverse·share (eq. 6); returns this part of J.

    By eq. 6 Σ_j μ_ji^m D²_ji = share^(m−1). The floor keeps a point that sits on centres finite: it then belongs to
    them in equal shares.
    """
    power, objective = 1.0 / (m - 1.0), 0.0
    floor = max(1e-300, 10.0 ** (-300.0 * (m - 1.0)))
    total = share[:samples]
    total[:] = 0.0
    for j in range(len(square)):
        d, q = square[j, :samples], inverse[j, :samples]
        for i in range(samples):
            q[i] = 1.0 / max(d[i], floor)
        if m != 2.0:
            for i in range(samples):
                q[i] = q[i] ** power
        for i in range(samples):
            total[i] += q[i]
    for i in range(samples):
        total[i] = 1.0 / total[i]
    if m == 2.0:
        return total_of(total)
    for i in range(samples):
        objective += total[i] ** (m - 1.0)
    return objective


@kernel
def cluster_widths(z, mu, centers):
    """σ_jk² = Σ_i μ_ji (x_ki − v_jk)² / Σ_i μ_ji (eq. 8; μ, not μ^m); returns σ, shape (clusters, columns)."""
    n, samples = z.shape
    clusters = mu.shape[0]
    widths = np.empty((clusters, n))
    for j in range(clusters):
        total = 0.0
        for i in range(samples):
            total += mu[j, i]
        for k in range(n):
            square, v = 0.0, centers[j, k]
            for i in range(samples):
                square += mu[j, i] * (z[k, i] - v) ** 2
            widths[j, k] = np.sqrt(square / total)
    return widths
