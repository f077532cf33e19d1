"""The regressors φ of a TS model: normalised firing strengths times [1, inputs] (PAPER eqs. 2, 9, 11 and §RLS)."""

import numpy as np

from rtcomp.jit import kernel


@kernel
def regressors(x, centers, widths, offset):
    """φ of every row, shape (samples, rules·(inputs + offset)): β_j·[1, x_1, …] rule by rule.

    β_j = w_j/Σw, w_j = exp(−½ Σ_k ((x_k − v_jk)/σ_jk)²); the largest exponent is taken out, so that points far
    from every centre do not underflow.
    """
    samples, k = x.shape
    rules = len(centers)
    size = k + 1 if offset else k
    phi = np.empty((samples, rules * size))
    firing = np.empty(rules)
    for i in range(samples):
        largest = -np.inf
        for j in range(rules):
            exponent = 0.0
            for h in range(k):
                apart = (x[i, h] - centers[j, h]) / widths[j, h]
                exponent -= 0.5 * apart * apart
            firing[j] = exponent
            largest = max(largest, exponent)
        total = 0.0
        for j in range(rules):
            firing[j] = np.exp(firing[j] - largest)
            total += firing[j]
        for j in range(rules):
            share = firing[j] / total
            start = j * size
            if offset:
                phi[i, start] = share
                start += 1
            for h in range(k):
                phi[i, start + h] = share * x[i, h]
    return phi


@kernel
def output_slopes(x, centers, widths, theta):
    """∂ŷ/∂(v, ln σ) at fixed consequents `theta` (rules, inputs + 1): shape (samples, 2·rules·inputs).

    With d = (x − v)/σ and ŷ = Σ β_j g_j:  ∂ŷ/∂v = β (g − ŷ) d/σ,  ∂ŷ/∂ln σ = β (g − ŷ) d².
    """
    samples, k = x.shape
    rules = len(centers)
    phi = regressors(x, centers, widths, True)
    slopes = np.empty((samples, 2 * rules * k))
    outputs = np.empty(rules)
    for i in range(samples):
        predicted = 0.0
        for j in range(rules):
            outputs[j] = theta[j, 0]
            for h in range(k):
                outputs[j] += theta[j, h + 1] * x[i, h]
            predicted += phi[i, j * (k + 1)] * outputs[j]
        for j in range(rules):
            part = phi[i, j * (k + 1)] * (outputs[j] - predicted)
            for h in range(k):
                d = (x[i, h] - centers[j, h]) / widths[j, h]
                slopes[i, j * k + h] = part * d / widths[j, h]
                slopes[i, rules * k + j * k + h] = part * d * d
    return slopes
