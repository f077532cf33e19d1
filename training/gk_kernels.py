"""Compiled passes of Gustafson-Kessel clustering over standardised points `z` (samples, columns), PAPER eqs. 3-8.

`mu` is the partition (samples, clusters), `m` the fuzziness. Each pass reads the rows once, in order.
"""

import numpy as np

from rtcomp.jit import kernel


@kernel
def weighted_centers(z, mu, m):
    """v_j = Σ_i μ_ji^m z_i / Σ_i μ_ji^m (eq. 7)."""
    samples, n = z.shape
    clusters = mu.shape[1]
    centers = np.zeros((clusters, n))
    weights = np.zeros(clusters)
    for i in range(samples):
        for j in range(clusters):
            w = mu[i, j] * mu[i, j] if m == 2.0 else mu[i, j] ** m
            weights[j] += w
            for k in range(n):
                centers[j, k] += w * z[i, k]
    for j in range(clusters):
        for k in range(n):
            centers[j, k] /= weights[j]
    return centers


@kernel
def weighted_covariances(z, mu, centers, m):
    """F_j = Σ_i μ_ji^m (z_i − v_j)(z_i − v_j)ᵀ / Σ_i μ_ji^m (eq. 5)."""
    samples, n = z.shape
    clusters = mu.shape[1]
    covariances = np.zeros((clusters, n, n))
    weights = np.zeros(clusters)
    for i in range(samples):
        for j in range(clusters):
            w = mu[i, j] * mu[i, j] if m == 2.0 else mu[i, j] ** m
            weights[j] += w
            for k in range(n):
                part = w * (z[i, k] - centers[j, k])
                for h in range(k + 1):
                    covariances[j, k, h] += part * (z[i, h] - centers[j, h])
    for j in range(clusters):
        for k in range(n):
            for h in range(k + 1):
                covariances[j, k, h] /= weights[j]
                covariances[j, h, k] = covariances[j, k, h]
    return covariances


@kernel
def update_partition(z, mu, centers, norms, m):
    """Distances (eq. 4) and memberships (eq. 6) in place; largest change of μ, and J (eq. 3).

    A point that sits on centres belongs to them in equal shares.
    """
    samples, n = z.shape
    clusters = mu.shape[1]
    square = np.empty(clusters)
    power = -1.0 / (m - 1.0)
    change, objective = 0.0, 0.0
    for i in range(samples):
        hits = 0
        for j in range(clusters):
            total = 0.0
            for k in range(n):
                apart = z[i, k] - centers[j, k]
                total += apart * apart * norms[j, k, k]
                for h in range(k):
                    total += 2.0 * apart * (z[i, h] - centers[j, h]) * norms[j, k, h]
            square[j] = max(total, 0.0)
            hits += square[j] < 1e-300
        share = 0.0
        for j in range(clusters):
            if hits == 0:
                share += 1.0 / square[j] if m == 2.0 else square[j] ** power
        for j in range(clusters):
            if hits > 0:
                new = 1.0 / hits if square[j] < 1e-300 else 0.0
            else:
                new = (1.0 / square[j] if m == 2.0 else square[j] ** power) / share
            change = max(change, abs(new - mu[i, j]))
            mu[i, j] = new
            objective += (new * new if m == 2.0 else new**m) * square[j]
    return change, objective


@kernel
def cluster_widths(z, mu, centers):
    """σ_jk² = Σ_i μ_ji (x_ki − v_jk)² / Σ_i μ_ji (eq. 8; μ, not μ^m)."""
    samples, n = z.shape
    clusters = mu.shape[1]
    squares = np.zeros((clusters, n))
    weights = np.zeros(clusters)
    for i in range(samples):
        for j in range(clusters):
            weights[j] += mu[i, j]
            for k in range(n):
                squares[j, k] += mu[i, j] * (z[i, k] - centers[j, k]) ** 2
    for j in range(clusters):
        for k in range(n):
            squares[j, k] = np.sqrt(squares[j, k] / weights[j])
    return squares
