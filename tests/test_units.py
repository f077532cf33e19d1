"""Units mean what physics says, and nothing is guessed."""

import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcomp.errors import RequestError
from rtcomp.units import rate_unit, temperature_unit


def convert(unit, value):
    return unit.factor * value + unit.offset


@pytest.mark.parametrize(
    ("text", "half_turn"),
    [
        ("deg/s", 180.0),
        ("°/s", 180.0),
        ("º/s", 180.0),
        (" deg/s ", 180.0),
        ("dps", 180.0),
        ("degrees/sec", 180.0),
        ("rad/s", math.pi),
        ("mrad/s", 1e3 * math.pi),
        ("mdeg/s", 180e3),
        ("deg/h", 180.0 * 3600.0),
        ("°/h", 180.0 * 3600.0),
        ("deg/min", 180.0 * 60.0),
    ],
)
def test_half_a_turn_per_second_is_180_dps_in_every_unit(text, half_turn):
    assert convert(rate_unit(text, "signal"), half_turn) == pytest.approx(180.0, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "freezing", "boiling"),
    [
        ("degC", 0.0, 100.0),
        ("°C", 0.0, 100.0),
        ("C", 0.0, 100.0),
        ("K", 273.15, 373.15),
        ("degF", 32.0, 212.0),
        ("°F", 32.0, 212.0),
    ],
)
def test_water_freezes_at_0_and_boils_at_100_in_every_unit(text, freezing, boiling):
    unit = temperature_unit(text, "signal")
    assert convert(unit, freezing) == pytest.approx(0.0, abs=1e-12)
    assert convert(unit, boiling) == pytest.approx(100.0, rel=1e-14)


@pytest.mark.parametrize("look_up", [rate_unit, temperature_unit])
@pytest.mark.parametrize("text", ["km/h", "m/s^2", "", None, "deg", "Deg/S", "rpm"])
def test_a_unit_of_another_kind_is_refused_with_what_was_got_and_wanted(look_up, text):
    with pytest.raises(RequestError) as error:
        look_up(text, "signal Speed of message ESP")
    assert "signal Speed of message ESP" in str(error.value)
    assert f"'{text}'" in str(error.value) if text else "no unit" in str(error.value)
    assert ("deg/s" if look_up is rate_unit else "degC") in str(error.value)


def test_a_rate_is_no_temperature_and_a_temperature_no_rate():
    with pytest.raises(RequestError, match="wanted one of degC"):
        temperature_unit("deg/s", "x")
    with pytest.raises(RequestError, match="wanted one of deg/s"):
        rate_unit("K", "x")


@given(st.text())
def test_any_text_is_either_known_or_refused(text):
    with contextlib.suppress(RequestError):
        assert rate_unit(text, "x").factor > 0
