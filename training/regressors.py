"""The regressors φ of a TS model: normalised firing strengths times [1, inputs] (PAPER eqs. 2, 9, 11 and §RLS)."""

import numpy as np


def firing_shares(x: np.ndarray, centers: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """β_j = w_j/Σw with w_j = exp(−½ Σ_k d_jk²), shape (samples, rules), and d_jk = (x_k − v_jk)/σ_jk.

    The largest exponent is taken out, so that points far from every centre do not underflow.
    """
    d = (x[:, None, :] - centers) / widths
    exponent = -0.5 * np.einsum("ijk,ijk->ij", d, d)
    shares = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    shares /= shares.sum(axis=1, keepdims=True)
    return shares, d


def regressors(x: np.ndarray, centers: np.ndarray, widths: np.ndarray, offset: bool) -> np.ndarray:
    """φ of every row, shape (samples, rules·(inputs + offset)): β_j·[1, x_1, …] rule by rule."""
    return spread(firing_shares(x, centers, widths)[0], x, offset)


def spread(shares: np.ndarray, x: np.ndarray, offset: bool) -> np.ndarray:
    """φ from the firing shares of the rows."""
    samples, rules = shares.shape
    k = x.shape[1]
    phi = np.empty((samples, rules, k + 1))
    phi[:, :, 0] = shares
    np.multiply(shares[:, :, None], x[:, None, :], out=phi[:, :, 1:])
    return phi[:, :, 0 if offset else 1 :].reshape(samples, -1)


def output_slopes(x: np.ndarray, centers: np.ndarray, widths: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """∂ŷ/∂(v, ln σ) at fixed consequents `theta` (rules, inputs + 1): shape (samples, 2·rules·inputs).

    With d = (x − v)/σ and ŷ = Σ β_j g_j:  ∂ŷ/∂v = β (g − ŷ) d/σ,  ∂ŷ/∂ln σ = β (g − ŷ) d².
    """
    shares, d = firing_shares(x, centers, widths)
    outputs = theta[:, 0] + x @ theta[:, 1:].T
    part = shares * (outputs - np.einsum("ij,ij->i", shares, outputs)[:, None])
    by_width = part[:, :, None] * d
    samples = len(x)
    return np.hstack([(by_width / widths).reshape(samples, -1), (by_width * d).reshape(samples, -1)])
