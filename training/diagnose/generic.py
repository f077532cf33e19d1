"""Bases without a name: any smooth function of one driver, to locate a mismatch and to catch unknown physics.

A basis is a set of hat functions (piecewise linear, corners at quantiles of the driver), multiplied by the rate for
the rate-times drivers.  They say on what a mismatch depends without saying what it is.
"""

from collections.abc import Callable

import numpy as np

from training.diagnose.library import PPM, Group, Parameters, Survey
from training.diagnose.work import FloatArray, Work

HATS = (9, 21)  # a smooth function, and one that can bend within a few percent of the range
Driver = Callable[[Work], FloatArray]


def _rate(work: Work) -> FloatArray:
    return work.w


def temperature_rate(work: Work) -> FloatArray:
    """dT/dt [K/s] smoothed over a minute, so that a coarse temperature channel keeps a slope."""
    from training.diagnose.work import smooth

    return np.gradient(smooth(work.temp, work.step_s, 40.0), work.step_s)


def _acceleration_of_rate(work: Work) -> FloatArray:
    return np.gradient(work.w, work.step_s)


VALUES: dict[str, tuple[Driver, bool, frozenset[str]]] = {
    "temperature": (lambda k: k.temp, False, frozenset({"temperature"})),
    "temperature_rate": (temperature_rate, False, frozenset({"temperature", "clock"})),
    "rate": (_rate, False, frozenset({"rate"})),
    "rate_times_temperature": (lambda k: k.temp, True, frozenset({"temperature", "rate"})),
    "rate_times_temperature_rate": (temperature_rate, True, frozenset({"temperature", "rate", "clock"})),
    "time": (lambda k: k.t, False, frozenset({"clock"})),
    "rate_times_time": (lambda k: k.t, True, frozenset({"rate", "clock"})),
    "time_since_power_on": (
        lambda k: np.log(np.maximum(k.t, 0.0) + 60.0),
        False,
        frozenset({"clock", "power_on"}),
    ),
    "angular_acceleration": (_acceleration_of_rate, False, frozenset({"rate", "clock"})),
    "speed": (lambda k: k.extra["speed"], False, frozenset({"speed"})),
    "acceleration": (lambda k: k.extra["accel"], False, frozenset({"acceleration"})),
    "vibration": (lambda k: k.extra["vib2"], False, frozenset({"vibration"})),
}
BENDING = frozenset({"temperature", "rate", "rate_times_temperature"})
TRANSITIONS = frozenset({"temperature", "rate_times_temperature"})
CYCLIC: dict[str, tuple[str, frozenset[str]]] = {
    "heading": ("", frozenset({"heading"})),
    "rate_times_heading": ("w", frozenset({"heading", "rate"})),
}


def knots_of(values: FloatArray, count: int) -> FloatArray:
    """Corners: half by rank, half by range, so that neither crowded nor rare values are without one."""
    ranks = np.quantile(values, np.linspace(0.0, 1.0, count))
    span = np.linspace(ranks[0], ranks[-1], count)
    return 0.5 * (ranks + span)


def hats(values: FloatArray, knots: FloatArray) -> list[FloatArray]:
    """Hat functions of the knots, the first left out (the nuisances carry the level)."""
    unit = np.eye(len(knots))
    return [np.interp(values, knots, unit[i]) for i in range(1, len(knots))]


def generic_groups(works: list[Work]) -> tuple[Group, ...]:
    """One group per driver these recordings have, with common knots."""
    groups = []
    for driver, (value, times_rate, needs) in VALUES.items():
        try:
            pooled = np.concatenate([value(work) for work in works])
        except KeyError:
            continue
        if np.ptp(pooled) <= 0.0:
            continue
        fine = HATS if driver in BENDING else HATS[:1]
        if works[0].points and "temperature" in driver:
            fine = (max(3, sum(int(np.max(w.clusters)) + 1 for w in works if w.clusters is not None) // 3),)
        sets = {float(n): knots_of(pooled, n) for n in fine}
        sets = {n: knots for n, knots in sets.items() if np.all(np.diff(knots) > 0.0)}
        if sets:
            groups.append(_hat_group(driver, value, times_rate, needs, sets))
    return (*groups, *(_cyclic_group(driver, prefix, needs) for driver, (prefix, needs) in CYCLIC.items()))


def _hat_group(
    driver: str, value: Driver, times_rate: bool, needs: frozenset[str], sets: dict[float, FloatArray]
) -> Group:
    unit = "ppm" if times_rate else "dps"

    def columns(work: Work, parameters: Parameters) -> list[FloatArray]:
        basis = basis_of(value(work), sets, parameters)
        return [PPM * work.w * column for column in basis] if times_rate else basis

    def names(parameters: Parameters) -> list[tuple[str, str]]:
        count = 1 if "centre" in parameters else len(sets[parameters["hats"]]) - 1
        return [(f"value_{i}", unit) for i in range(1, count + 1)]

    return Group(
        driver, lambda survey: [{"hats": n} for n in sets] + _sigmoids(driver, sets), columns, names, needs
    )


def basis_of(values: FloatArray, sets: dict[float, FloatArray], parameters: Parameters) -> list[FloatArray]:
    """The basis functions of one variant at `values`: hats, or one sigmoid (a transition at a value of the driver)."""
    if "centre" in parameters:
        return [0.5 * (1.0 + np.tanh((values - parameters["centre"]) / parameters["width"]))]
    return hats(values, sets[parameters["hats"]])


def _sigmoids(driver: str, sets: dict[float, FloatArray]) -> list[Parameters]:
    """Transitions across the driver's range, sharp to soft, for the temperature drivers."""
    if driver not in TRANSITIONS:
        return []
    knots = next(iter(sets.values()))
    span = float(knots[-1] - knots[0])
    centres = np.linspace(knots[0] + 0.06 * span, knots[-1] - 0.06 * span, 28)
    return [
        {"hats": 0.0, "centre": float(c), "width": float(share * span)}
        for c in centres
        for share in (0.012, 0.03, 0.08)
    ]


def _cyclic_group(driver: str, prefix: str, needs: frozenset[str]) -> Group:
    keys = [f"{prefix}{kind}{k}" for k in (1, 2) for kind in ("cos", "sin")]
    return Group(
        driver,
        _one,
        lambda work, p: [work.extra[key] for key in keys],
        lambda p: [(k, "dps") for k in keys],
        needs,
    )


def _one(survey: Survey) -> list[Parameters]:
    return [{}]
