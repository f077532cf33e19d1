"""The physical base: planted coefficients, extrapolation, rules only where they help."""

import numpy as np
import pytest

from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.model import OpenLoopSine
from training.gk import Settings
from training.physics_informed import add_rules, fit_base, fit_physics
from training.rate_table import ReferenceGyro, simulate, split_inside
from training.ts import TsOptions

OPTIONS = TsOptions("gk-rls", 4, clustering=Settings(starts=1))


def test_planted_coefficients_are_recovered():
    gyro = ReferenceGyro(soak_scale=0.0, read_noise_dps=0.0)
    table = simulate(0, gyro)
    base = fit_base(table.temp_degC, table.rate_dps, table.error_dps).base
    assert isinstance(base, OpenLoopSine)
    for name in ("K0_s", "alpha_per_K", "g0", "g1_per_K", "g2_per_K2"):
        assert getattr(base, name) == pytest.approx(getattr(gyro.surface, name), rel=0.02)


def test_extrapolates_where_free_rules_do_not():
    table = simulate(1)
    train = split_inside(table, (-10.0, 40.0), 120.0)
    model = fit_base(table.temp_degC[train], table.rate_dps[train], table.error_dps[train])
    given = predict(model, table.rate_dps, table.temp_degC)
    truth = table.gyro.error_dps(table.temp_degC, table.rate_dps)
    assert np.abs(given.error_dps - truth)[~train].max() < 0.3
    assert not given.flags.any()


def test_rules_are_left_out_where_the_base_says_all():
    table = simulate(2)
    found = fit_physics(table.temp_degC, table.rate_dps, table.error_dps, table.soak, OPTIONS)
    assert not found.model.rules.centers
    assert found.score_with_rules_dps is not None


def test_rules_take_what_the_base_cannot():
    table = simulate(2)
    bump = 3.0 * ((table.temp_degC - 10) / 45) ** 2
    found = fit_physics(table.temp_degC, table.rate_dps, table.error_dps + bump, table.soak, OPTIONS)
    base = fit_base(table.temp_degC, table.rate_dps, table.error_dps + bump)
    both = add_rules(base, table.temp_degC, table.rate_dps, table.error_dps + bump, OPTIONS)
    left = [
        np.std(table.error_dps + bump - predict(model, table.rate_dps, table.temp_degC).error_dps)
        for model in (base, both)
    ]
    assert left[1] < 0.8 * left[0]
    assert found.model.rules.centers


def test_unexcited_inputs_are_named():
    table = simulate(0)
    with pytest.raises(RequestError, match="temp_degC spans 0"):
        fit_base_checked(np.full(648, 20.0), table.rate_dps, table.error_dps, table.soak)
    with pytest.raises(RequestError, match="rate_dps spans"):
        fit_base_checked(table.temp_degC, 0.01 * table.rate_dps, table.error_dps, table.soak)
    with pytest.raises(RequestError, match="10 points"):
        fit_base_checked(*(a[:10] for a in (table.temp_degC, table.rate_dps, table.error_dps, table.soak)))


def fit_base_checked(temp, rate, error, groups):
    return fit_physics(temp, rate, error, groups, None)
