"""The exponential of the compiled step, against the C library's in longer numbers."""

import math

import numpy as np
import pytest

from rtcomp.exponential import LOWEST, exp_falling
from rtcomp.jit import kernel


@kernel
def fill(x, out):
    for i in range(len(x)):
        out[i] = exp_falling(x[i])


def arguments():
    random = np.random.default_rng(0)
    spread = -np.concatenate(
        [random.exponential(20.0, 4000), random.uniform(0, 1, 4000), 10.0 ** -np.arange(300)]
    )
    return np.concatenate([spread[spread >= LOWEST], [0.0, -math.log(2) / 2, LOWEST]])


def test_within_one_unit_in_the_last_place():
    x = arguments()
    got, true = np.empty_like(x), np.exp(x.astype(np.longdouble))
    fill(x, got)
    assert (np.abs(got - true) <= np.spacing(np.exp(x))).all()


def test_one_by_one_and_in_vectors_to_the_bit():
    x = arguments()
    together = np.empty_like(x)
    fill(x, together)
    alone = [exp_falling(value) for value in x[::7]]
    assert (np.array(alone).view(np.int64) == together[::7].view(np.int64)).all()


@pytest.mark.parametrize(("x", "expected"), [(0.0, 1.0), (-np.inf, 0.0), (-709.0, 0.0), (-1e300, 0.0)])
def test_ends(x, expected):
    assert exp_falling(np.float64(x)) == expected


def test_what_is_not_a_number_stays_so():
    assert math.isnan(exp_falling(np.float64(np.nan)))
