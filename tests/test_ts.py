"""TS identification: planted systems, units, analytic slopes, refinement, number of rules, refusals."""

import numpy as np
import pytest

from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.model import Rules
from training import ts
from training.build import ts_model
from training.gk import Settings
from training.refine import Antecedents, refine
from training.regressors import output_slopes, regressors
from training.ts import TsOptions, choose_rules, fit, rules_output

NAMES = ["temp_degC", "rate_dps"]
PLANTED = Rules(
    centers=[[-10.0, -60.0], [40.0, 70.0]],
    widths=[[18.0, 60.0], [15.0, 55.0]],
    consequents=[[1.0, -0.05, 0.02], [-2.0, 0.08, -0.01]],
)
QUICK = Settings(starts=2)


def planted(n=400, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    inputs = np.column_stack([rng.uniform(-30, 60, n), rng.uniform(-150, 150, n)])
    return inputs, rules_output(PLANTED, inputs) + noise * rng.standard_normal(n)


def naive_output(rules, x):
    w = [
        np.exp(-0.5 * sum(((x - np.array(v)) / np.array(s)) ** 2))
        for v, s in zip(rules.centers, rules.widths, strict=True)
    ]
    g = [a[0] + np.dot(a[1:], x) for a in rules.consequents]
    return np.dot(w, g) / np.sum(w)


def test_output_is_the_printed_equations():
    inputs, error = planted(20)
    for x, y in zip(inputs, error, strict=True):
        assert y == pytest.approx(naive_output(PLANTED, x), rel=1e-12)


def test_firing_strengths_sum_to_one_even_far_away():
    far = np.array([[1e4, -1e5], [0.0, 0.0]])
    phi = regressors(far, np.array(PLANTED.centers), np.array(PLANTED.widths), True)
    np.testing.assert_allclose(phi[:, 0] + phi[:, 3], 1.0)


def test_slopes_are_the_derivatives_of_the_output():
    x = planted(15)[0]
    centers, widths = np.array(PLANTED.centers), np.array(PLANTED.widths)
    theta = np.array(PLANTED.consequents)
    slopes = output_slopes(x, centers, widths, theta)
    vector = Antecedents(centers, widths)
    for k, step in enumerate(np.eye(8) * 1e-5):
        two = [vector.like(vector.vector() + sign * step) for sign in (1, -1)]
        up, down = (regressors(x, a.centers, a.widths, True) @ theta.ravel() for a in two)
        np.testing.assert_allclose(slopes[:, k], (up - down) / 2e-5, rtol=1e-5, atol=1e-7)


def test_refinement_recovers_a_planted_system():
    inputs, error = planted()
    scale = inputs.std(axis=0)
    start = Antecedents(
        (np.array(PLANTED.centers) + np.array([6.0, -15.0])) / scale, np.array(PLANTED.widths) * 1.3 / scale
    )
    found = refine(inputs / scale, error, start)
    phi, first = (regressors(inputs / scale, a.centers, a.widths, True) for a in (found, start))
    left = [np.std(error - p @ np.linalg.lstsq(p, error, rcond=None)[0]) for p in (phi, first)]
    assert left[0] < 0.1 * left[1]


def test_identification_of_a_planted_system_reaches_its_noise():
    inputs, error = planted(600, noise=0.01)
    fresh, truth = planted(300, seed=9)
    refined = fit(inputs, error, NAMES, TsOptions(rules=2, clustering=QUICK))
    plain = fit(inputs, error, NAMES, TsOptions("gk-rls", 2, clustering=QUICK))
    assert np.std(truth - rules_output(refined.rules, fresh)) < 0.01
    assert refined.residual_std_dps < 0.012
    assert plain.residual_std_dps > refined.residual_std_dps


@pytest.mark.parametrize("method", ["gk-rls", "gk-rls-refined"])
def test_units_do_not_matter(method):
    inputs, error = planted(noise=0.01)
    options = TsOptions(method, 2, clustering=QUICK)
    one = rules_output(fit(inputs, error, NAMES, options).rules, inputs)
    changed = inputs * [1.8, 1e-3] + [32.0, 0.0]
    other = rules_output(fit(changed, 3600 * error, NAMES, options).rules, changed)
    np.testing.assert_allclose(other / 3600, one, atol=2e-4)


def test_phi_without_the_offset_has_no_constants():
    inputs, error = planted()
    found = fit(inputs, error, NAMES, TsOptions("gk-rls", 2, offset=False, clustering=QUICK))
    assert all(row[0] == 0.0 for row in found.rules.consequents)
    with pytest.raises(RequestError, match="printed form"):
        TsOptions(offset=False)


def test_consequents_do_not_depend_on_the_size_of_the_chunks(monkeypatch):
    inputs, error = planted()
    options = TsOptions("gk-rls", 2, clustering=QUICK)
    whole = fit(inputs, error, NAMES, options)
    monkeypatch.setattr(ts, "CHUNK", 37)
    assert fit(inputs, error, NAMES, options).rules == whole.rules


def test_the_vehicle_computes_what_was_trained():
    inputs, error = planted(noise=0.01)
    found = fit(inputs, error, NAMES, TsOptions(rules=3, clustering=QUICK))
    model = ts_model(found, NAMES, inputs)
    given = predict(model, inputs[:, 1], inputs[:, 0])
    np.testing.assert_allclose(given.error_dps, rules_output(found.rules, inputs), rtol=1e-9, atol=1e-10)
    assert not given.flags.any()


def test_number_of_rules_is_the_planted_one():
    inputs, error = planted(360, noise=0.02)
    groups = np.arange(360) // 20
    options = TsOptions(clustering=Settings(starts=1))
    count, scores = choose_rules(inputs, error, groups, NAMES, options, candidates=(1, 2, 4))
    assert count == 2
    assert scores[1] > 3 * scores[2]


def test_refinement_of_a_large_recording_says_what_it_looked_at(monkeypatch):
    monkeypatch.setattr(ts, "REFINE_ROWS", 200)
    inputs, error = planted()
    found = fit(inputs, error, NAMES, TsOptions(rules=2, clustering=QUICK))
    assert any("200 of 400 rows" in note for note in found.notes)


def test_refusals_name_what_is_wrong():
    inputs, error = planted(40)
    with pytest.raises(RequestError, match="12 points for 14 parameters"):
        fit(inputs[:12], error[:12], NAMES, TsOptions(rules=2))
    still = inputs.copy()
    still[:, 0] = 25.0
    with pytest.raises(RequestError, match="degenerate: temp_degC is constant"):
        fit(still, error, NAMES, TsOptions(rules=2))
    error[3] = np.inf
    with pytest.raises(RequestError, match=r"error_dps: 1 of 40 rows"):
        fit(inputs, error, NAMES, TsOptions(rules=2))
    with pytest.raises(RequestError, match="one group only"):
        choose_rules(*planted(), np.zeros(400), NAMES, TsOptions())
    with pytest.raises(RequestError, match="give one of gk-rls"):
        TsOptions("anfis")


def test_where_no_number_of_rules_can_be_fitted_the_reason_is_named():
    inputs, error = planted()
    inputs = inputs.copy()
    inputs[:, 0] = 20.0
    with pytest.raises(RequestError, match=f"{NAMES[0]} is constant at 20"):
        choose_rules(inputs, error, np.arange(len(error)) % 5, NAMES, TsOptions(), candidates=(1, 2))
