"""The compiled step against slow, obvious twins, and the physics of its dynamic terms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from rtcomp.compensator import FIRST, Compensator, predict
from rtcomp.errors import RequestError
from rtcomp.frames import Flag
from rtcomp.model import OpenLoopSine, Polynomial, ResidualTable, Rules, Term, new_model
from rtcomp.step import BLOCK, new_rows, predict_error, predict_rows

NS = 1_000_000_000


def term(effect, **parameters):
    return new_model(terms=[{"effect": effect, "parameters": parameters}])


def paper_equations(model, inputs):
    """PAPER eqs. 1, 2, 9-11 as printed."""
    v, sigma, a = (np.array(x) for x in (model.rules.centers, model.rules.widths, model.rules.consequents))
    memberships = np.exp(-0.5 * (inputs[:, None, :] - v) ** 2 / sigma**2)
    firing = memberships.prod(axis=2)
    outputs = a[:, 0] + inputs @ a[:, 1:].T
    return (firing * outputs).sum(axis=1) / firing.sum(axis=1)


def test_rules_are_the_papers_equations(ts_model):
    random = np.random.default_rng(1)
    temp, rate = random.uniform(-40, 70, 500), random.uniform(-200, 200, 500)
    expected = paper_equations(ts_model, np.column_stack([temp, rate]))
    assert np.allclose(predict(ts_model, rate, temp).error_dps, expected, rtol=0, atol=1e-12)


@settings(max_examples=50)
@given(st.integers(1, 4), st.integers(1, 6), st.integers(0, 1000))
def test_any_number_of_rules_and_inputs(inputs, rules, seed):
    random = np.random.default_rng(seed)
    names = ["temp_degC", "rate_dps", "coil_temp_degC", "lag_temp_degC"][:inputs]
    model = new_model(
        inputs=names,
        rules=Rules(
            random.normal(0, 20, (rules, inputs)).tolist(),
            random.uniform(5, 40, (rules, inputs)).tolist(),
            random.normal(0, 1, (rules, inputs + 1)).tolist(),
        ),
    )
    columns = random.normal(0, 15, (20, 4))
    columns[:, 3] = columns[:, 0]  # rows are independent: a soaked lag shows the temperature itself
    got = predict(model, columns[:, 1], columns[:, 0], coil_temp_degC=columns[:, 2]).error_dps
    assert np.allclose(got, paper_equations(model, columns[:, :inputs]), rtol=1e-9, atol=1e-9)


def test_far_from_every_rule_the_nearest_one_answers(ts_model):
    import msgspec

    unlimited = msgspec.structs.replace(ts_model, validity={})
    assert np.isfinite(predict(unlimited, np.array([1e6]), np.array([1e5])).error_dps).all()


def test_outside_the_validity_inputs_are_clipped_and_flagged(ts_model):
    prediction = predict(ts_model, np.array([150.0, 500.0, 200.0]), np.array([20.0, 20.0, 20.0]))
    assert prediction.error_dps[1] == prediction.error_dps[2]
    assert [bool(f & Flag.EXTRAPOLATING) for f in prediction.flags] == [False, True, False]


def test_sine_base_inverts_the_interferometer():
    base = OpenLoopSine(K0_s=0.178, alpha_per_K=-350e-6, g0=0.041, g1_per_K=-950e-6, g2_per_K2=1.5e-6)
    model = new_model(
        base={"kind": "open_loop_sine", **{f: getattr(base, f) for f in base.__struct_fields__}}
    )
    rate, temp = np.meshgrid(np.linspace(-180, 180, 37), np.linspace(-30, 60, 19))
    rate, h = rate.ravel(), temp.ravel() - 25.0
    gain = 1 + base.g0 + base.g1_per_K * h + base.g2_per_K2 * h * h
    measured = np.degrees(
        gain * np.sin(base.K0_s * (1 + base.alpha_per_K * h) * np.radians(rate)) / base.K0_s
    )
    assert np.allclose(measured - predict(model, measured, temp.ravel()).error_dps, rate, atol=1e-9)


def test_polynomial_base_is_a_polynomial():
    coefficients = [[0.1, 0.02, 0.0, 1e-6], [0.01, -1e-4], [1e-3]]
    model = new_model(base=Polynomial(coefficients, 20.0))
    rate, temp = np.linspace(-100, 100, 21), np.linspace(-20, 50, 21)
    padded = np.zeros((3, 4))
    for i, row in enumerate(coefficients):
        padded[i, : len(row)] = row
    assert np.allclose(
        predict(model, rate, temp).error_dps, np.polynomial.polynomial.polyval2d(temp - 20.0, rate, padded)
    )


def uneven_times(n, seed):
    return np.cumsum(np.random.default_rng(seed).uniform(0.01, 3.0, n))


def test_lag_is_the_differential_equation_whatever_the_sampling():
    t = uneven_times(800, 2)
    temp = np.interp(t, [0, 200, 500, 900, 2000], [20.0, 20.0, 45.0, 10.0, 10.0])
    solution = solve_ivp(
        lambda s, y: (np.interp(s, t, temp) - y) / 120.0,
        (t[0], t[-1]),
        [temp[0]],
        t_eval=t,
        rtol=1e-9,
        max_step=1.0,
    )
    model = term("thermal_lag", tau_s=120.0, bias_dps_per_K=1.0)
    assert np.allclose(predict(model, np.zeros(800), temp, t).error_dps, solution.y[0] - temp, atol=1e-4)


def test_lag_multiplies_the_rate_as_corrected_so_far():
    t, rate = np.arange(100.0), np.full(100, 50.0)
    temp = 20.0 + 0.1 * t
    base = {"effect": "scale_error", "parameters": {"ppm": 0.0}}
    lag = {"effect": "thermal_lag", "parameters": {"tau_s": 30.0, "scale_ppm_per_K": 1000.0}}
    alone = predict(new_model(terms=[lag]), rate, temp, t).error_dps
    half = new_model(base=Polynomial([[0.0, 0.5]]), terms=[lag, base])
    assert np.allclose(predict(half, rate, temp, t).error_dps - 25.0, alone / 2)


def test_second_pole_lags_further_and_ends_at_the_same_ramp_offset():
    t = np.arange(0.0, 4000.0)
    temp = 20.0 + 0.01 * t
    one = predict(term("thermal_lag", tau_s=150.0, bias_dps_per_K=1.0), t * 0, temp, t).error_dps
    two = predict(term("thermal_lag", tau_s=100.0, tau2_s=50.0, bias_dps_per_K=1.0), t * 0, temp, t).error_dps
    assert np.isclose(one[-1], -0.01 * 150.0, rtol=1e-6)
    assert np.isclose(two[-1], one[-1], rtol=1e-6)
    assert abs(two[60]) > abs(one[60])


def test_shupe_columns_are_the_filtered_derivatives():
    t = np.arange(0.0, 3000.0, 0.5)
    temp = 20.0 + 0.02 * np.clip(t - 500.0, 0, 1000)
    lagged = -predict(term("thermal_lag", tau_s=200.0, bias_dps_per_K=1.0), t * 0, temp, t).error_dps / 200.0
    first = predict(term("shupe", tau_s=200.0, c1_dps_s_per_K=1.0), t * 0, temp, t).error_dps
    second = predict(term("shupe", tau_s=200.0, c2_dps_s2_per_K=1.0), t * 0, temp, t).error_dps
    assert np.allclose(first, lagged, atol=1e-12)
    assert np.allclose(second[1:], np.diff(first) / 0.5, atol=2e-7)  # their relation, to the step's order


def test_play_depends_on_the_path_and_not_on_the_speed():
    path = np.concatenate([np.linspace(20, 40, 200), np.linspace(40, 25, 150), np.linspace(25, 30, 50)])
    model = term("bias_hysteresis", play_K=3.0, c_dps_per_K=1.0)
    slow = predict(model, path * 0, path, np.arange(400) * 10.0).error_dps
    fast = predict(model, path * 0, path, np.arange(400) * 0.1).error_dps
    assert np.array_equal(slow, fast)
    assert np.isclose(slow[199], -3.0)  # heating: the play trails by its half-width
    assert np.isclose(slow[349], 3.0)  # cooling: it trails from above


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (
            term("bias_temperature", b1_dps_per_K=0.1, b2_dps_per_K2=0.01),
            lambda w, h, t: 0.1 * h + 0.01 * h**2,
        ),
        (term("scale_temperature", s1_ppm_per_K=100.0), lambda w, h, t: w * 1e-4 * h),
        (term("scale_nonlinearity", c3_per_dps2=1e-6), lambda w, h, t: 1e-6 * w**3),
        (term("scale_asymmetry", c_ppm=500.0), lambda w, h, t: 5e-4 * np.abs(w)),
        (term("bias_warmup", amplitude_dps=2.0, tau_s=100.0), lambda w, h, t: 2 * np.exp(-t / 100)),
        (term("scale_warmup", amplitude_ppm=1e4, tau_s=50.0), lambda w, h, t: w * 0.01 * np.exp(-t / 50)),
        (term("polarization_ripple", period_K=6.0, sin_dps=1.0), lambda w, h, t: np.sin(2 * np.pi * h / 6)),
        (term("compensation_table", period_K=5.0, amplitude_dps=1.0), lambda w, h, t: 2 * ((h / 5) % 1) - 1),
        (term("bias_drift", c_dps_per_s=1e-3), lambda w, h, t: 1e-3 * t),
        (term("source_ageing", c_ppm_per_s=10.0), lambda w, h, t: w * 1e-5 * t),
        (term("scale_error", ppm=700.0), lambda w, h, t: w * 7e-4),
        (term("bias_error", dps=0.3), lambda w, h, t: 0.3 + 0 * w),
        (term("unit_error", factor=2.0), lambda w, h, t: w / 2),
    ],
)
def test_terms_without_memory_are_their_equations(model, expected):
    random = np.random.default_rng(3)
    t = np.arange(200.0)
    rate, temp = random.uniform(-100, 100, 200), random.uniform(-20, 60, 200)
    assert np.allclose(predict(model, rate, temp, t).error_dps, expected(rate, temp - 25.0, t), atol=1e-9)


def test_empirical_term_interpolates_its_driver():
    model = new_model(
        terms=[
            Term("unknown", {"driver": "temperature", "knots": [0.0, 10.0, 30.0], "values": [1.0, 3.0, -1.0]})
        ]
    )
    temp = np.array([-5.0, 0.0, 5.0, 20.0, 30.0, 99.0])
    assert np.allclose(predict(model, temp * 0, temp).error_dps, [1.0, 1.0, 2.0, 1.0, -1.0, -1.0])


def test_a_stack_adds_up(ts_model):
    t, rate = np.arange(300.0), np.linspace(-100, 100, 300)
    temp = 20 + 0.05 * t
    extra = term("bias_warmup", amplitude_dps=0.5, tau_s=60.0)
    both = predict([ts_model, extra], rate, temp, t)
    assert np.allclose(both.error_dps, predict(ts_model, rate, temp, t).error_dps + 0.5 * np.exp(-t / 60))
    assert (both.sigma_dps == 0.03).all()


def test_residual_table_is_looked_up_by_region():
    table = ResidualTable([-30.0, 20.0, 60.0], [-200.0, 0.0, 200.0], [[1.0, 2.0], [3.0, 4.0]])
    got = predict(
        new_model(residual_std_dps=table),
        np.array([-10.0, 10.0, -10.0, 500.0]),
        np.array([0.0, 0.0, 30.0, 99.0]),
    )
    assert got.sigma_dps.tolist() == [1.0, 2.0, 3.0, 4.0]


def test_unsettled_until_the_start_no_longer_matters_and_again_after_a_gap(lag_model):
    import msgspec

    model = msgspec.structs.replace(lag_model, terms=[Term("thermal_lag", {"tau_s": 10.0})])
    compensator = Compensator([model], power_on_ns=0)
    seen = []
    for second in [*range(0, 80), *range(400, 480)]:
        compensator.temperature(second * NS, 20.0)
        seen.append(bool(compensator.correct(second * NS, 1.0)[1] & Flag.UNSETTLED))
    assert seen[:80] == [True] * 50 + [False] * 30
    assert seen[80:] == [True] * 50 + [False] * 30


def test_without_power_on_time_terms_are_left_out_and_flagged():
    model = term("bias_warmup", amplitude_dps=1.0, tau_s=100.0)
    got = predict(model, np.zeros(3), np.full(3, 20.0), np.arange(3.0), power_on_known=False)
    assert not got.error_dps.any()
    assert all(flag & Flag.UNSETTLED for flag in got.flags)


def test_a_model_that_needs_a_temperature_waits_for_one(ts_model):
    got = predict(ts_model, np.ones(3), np.array([np.nan, np.nan, 20.0]), np.arange(3.0))
    assert [bool(f & Flag.TEMPERATURE_MISSING) for f in got.flags] == [True, True, False]
    assert got.error_dps[0] == 0.0 != got.error_dps[2]


def test_time_that_runs_backwards_does_not_move_a_thermal_state():
    model = term("thermal_lag", tau_s=10.0, bias_dps_per_K=1.0)
    compensator = Compensator([model], power_on_ns=0)
    for second, temp in [(0, 20.0), (10, 30.0)]:
        compensator.temperature(second * NS, temp)
    before = compensator.correct(10 * NS, 0.0)[0]
    compensator.temperature(5 * NS, 90.0)
    assert compensator.correct(11 * NS, 0.0)[0] == before


def test_shapes_that_differ_are_refused(ts_model):
    with pytest.raises(RequestError, match="differ in shape"):
        predict(ts_model, np.zeros(3), np.zeros(4))


@settings(max_examples=40)
@given(st.integers(0, 5), st.integers(1, 300), st.integers(0, 1000))
def test_a_block_of_rates_has_the_bits_of_each_alone(case, count, seed):
    random = np.random.default_rng(seed)
    rules = Rules(
        [[10.0, -50.0], [30.0, 60.0]], [[12.0, 40.0], [9.0, 70.0]], [[0.1, 0.01, 0.02], [0.3, -0.01, 0.0]]
    )
    inputs = [
        ["temp_degC", "rate_dps"],
        ["rate_dps", "coil_temp_degC"],
        ["temp_degC", "time_since_power_on_s"],
    ][case % 3]
    lag = {"effect": "thermal_lag", "parameters": {"tau_s": 30.0, "bias_dps_per_K": 0.01}}
    warm_up = {"effect": "bias_warmup", "parameters": {"amplitude_dps": 0.2, "tau_s": 100.0}}
    base = {"kind": "open_loop_sine", "K0_s": 0.178, "alpha_per_K": -350e-6} if case > 2 else None
    model = new_model(
        inputs=inputs, rules=rules, base=base, terms=[lag, warm_up], validity={"rate_dps": (-150.0, 150.0)}
    )
    alone, together = Compensator([model], 0), Compensator([model], 0)
    rows, t_ns, rate = new_rows(), np.arange(1, count + 1) * NS, random.uniform(-1e4, 200.0, count)
    for compensator in (alone, together):
        compensator.temperature(0, 20.0, 21.0)
        compensator.temperature(NS // 2, 20.5, 21.0)
    n = min(count, BLOCK)
    rows.t_ns[:n], rows.rate[:n] = t_ns[:n], rate[:n]
    predict_rows(together.compiled, together.state, rows, FIRST, n)
    each = [predict_error(alone.compiled, alone.state, FIRST, t_ns[k], rate[k]) for k in range(n)]
    assert np.array([error for error, _ in each]).tobytes() == rows.error[:n].tobytes()
    assert [flags for _, flags in each] == rows.flags[:n].tolist()
