"""The simulated rate table: the paper's protocol, the reference gyro, and its splits."""

import numpy as np
import pytest

from training.rate_table import (
    Protocol,
    ReferenceGyro,
    average,
    coil_temperatures,
    simulate,
    simulate_samples,
    split_inside,
    split_points,
    split_soaks,
)

QUIET = ReferenceGyro(soak_scale=0.0, read_noise_dps=0.0)


def test_the_protocol_is_the_papers():
    table = simulate(0)
    assert len(table.rate_dps) == 648
    assert table.temp_degC.min() == -30
    assert np.abs(table.true_dps).max() == 180
    assert split_points(table).sum() == 448
    assert 7.5 * 60 < Protocol().samples * Protocol().period_s <= 600


def test_same_seed_same_bits():
    np.testing.assert_array_equal(simulate(3).rate_dps, simulate(3).rate_dps)
    assert not np.array_equal(simulate(3).rate_dps, simulate(4).rate_dps)


def test_the_oracle_inverts_the_surface():
    temp, rate = (axis.ravel() for axis in np.meshgrid([-30.0, 0.0, 25.0, 55.0], np.linspace(-180, 180, 13)))
    gyro = ReferenceGyro()
    measured = gyro.measured_dps(temp, rate)
    np.testing.assert_allclose(measured - gyro.error_dps(temp, measured), rate, atol=1e-10)


def test_the_surface_is_as_large_as_the_papers():
    error = simulate(0).error_dps
    assert np.abs(error).max() == pytest.approx(11.6, rel=0.02)
    assert error.std() == pytest.approx(4.63, rel=0.05)


def test_without_noise_the_lsb_is_averaged_away():
    table = simulate(1, QUIET)
    left = table.error_dps - QUIET.error_dps(table.temp_degC, table.rate_dps)
    assert np.abs(left).max() < 0.001


def test_points_of_one_soak_share_their_scale_error():
    table = simulate(2, ReferenceGyro(read_noise_dps=0.0))
    left = table.error_dps - table.gyro.error_dps(table.temp_degC, table.rate_dps)
    shares = [np.polyfit(table.true_dps[table.soak == k], left[table.soak == k], 1)[0] for k in range(18)]
    assert np.std(shares) == pytest.approx(280e-6, rel=0.5)


def test_samples_are_multiples_of_the_lsb_and_average_to_the_table():
    gyro, protocol = ReferenceGyro(), Protocol(temps_degC=(0.0, 5.0), rates_dps=(-10.0, 10.0))
    readings = simulate_samples(0, gyro, protocol)
    assert readings.shape == (4, 1000)
    np.testing.assert_allclose(readings / gyro.lsb_dps, np.rint(readings / gyro.lsb_dps), atol=1e-6)
    np.testing.assert_array_equal(average(readings, 0, gyro, protocol).rate_dps, readings.mean(axis=1))


def test_two_hours_of_soak_leave_nothing_of_the_step_and_ten_minutes_do():
    gyro = ReferenceGyro()
    temps = np.array([-30.0, -25.0])
    assert np.abs(coil_temperatures(temps, gyro, Protocol()) - temps).max() < 1e-6
    short = coil_temperatures(temps, gyro, Protocol(soak_s=600.0))
    assert short[1] == pytest.approx(-25 - 5 * np.exp(-600 / 280))


def test_soak_split_never_divides_a_soak():
    table = simulate(5)
    train = split_soaks(table)
    assert not set(table.soak[train]) & set(table.soak[~train])
    assert abs(train.sum() - 448) <= 18


def test_inside_split():
    table = simulate(0)
    train = split_inside(table, (-10.0, 40.0), 120.0)
    assert table.temp_degC[train].min() == -10
    assert table.temp_degC[train].max() == 40
    assert np.abs(table.true_dps[train]).max() == 120
