"""The one place that knows units: what a signal's unit string means in °/s or °C.

A wrong unit is the costliest mistake a map can make, because the numbers still look like a gyro's. So a
string that is not known to be a rate of turn (or a temperature) is refused instead of guessed.
"""

import math
from typing import NamedTuple

from rtcomp.errors import RequestError


class Unit(NamedTuple):
    """`value_in_our_unit = factor · value + offset`."""

    factor: float
    offset: float = 0.0


_DEG_PER_RAD = 180.0 / math.pi

_RATES = {
    "deg/s": Unit(1.0),
    "mdeg/s": Unit(1e-3),
    "rad/s": Unit(_DEG_PER_RAD),
    "mrad/s": Unit(1e-3 * _DEG_PER_RAD),
    "deg/h": Unit(1.0 / 3600.0),
    "deg/min": Unit(1.0 / 60.0),
}
_TEMPERATURES = {
    "degC": Unit(1.0),
    "K": Unit(1.0, -273.15),
    "degF": Unit(5.0 / 9.0, -32.0 * 5.0 / 9.0),
}
_SPELLINGS = {
    "deg/sec": "deg/s",
    "degree/s": "deg/s",
    "degrees/s": "deg/s",
    "degrees/sec": "deg/s",
    "dps": "deg/s",
    "rad/sec": "rad/s",
    "deg/hr": "deg/h",
    "C": "degC",
    "celsius": "degC",
    "Celsius": "degC",
    "Kelvin": "K",
    "kelvin": "K",
    "degK": "K",
    "F": "degF",
    "Fahrenheit": "degF",
}


def _canonical(text: str) -> str:
    """One spelling for the many of one unit; ° and º (the ordinal sign some editors write) both mean deg."""
    plain = text.strip().replace("°", "deg").replace("º", "deg").replace(" ", "")
    return _SPELLINGS.get(plain, plain)


def _look_up(text: str | None, known: dict[str, Unit], quantity: str, owner: str) -> Unit:
    unit = known.get(_canonical(text or ""))
    if unit is None:
        got = f"its unit is '{text}'" if text else "it has no unit"
        raise RequestError(
            f"{owner} cannot be read as a {quantity}: {got}, wanted one of {', '.join(known)}; "
            "map another signal, or state `unit` in the signal map where the DBC's is wrong or missing"
        )
    return unit


def rate_unit(text: str | None, owner: str) -> Unit:
    """What the unit string means in °/s. `owner` names the signal in the RequestError of an unfit unit."""
    return _look_up(text, _RATES, "rate of turn", owner)


def temperature_unit(text: str | None, owner: str) -> Unit:
    """What the unit string means in °C. `owner` names the signal in the RequestError of an unfit unit."""
    return _look_up(text, _TEMPERATURES, "temperature", owner)
