"""Bases without a name: any smooth function of one driver, to locate a mismatch and to catch unknown physics.

A basis is a set of hat functions (piecewise linear, corners at quantiles of the driver), multiplied by the rate for
the rate-times drivers.  They say on what a mismatch depends without saying what it is.
"""

from collections.abc import Callable

import numpy as np

from training.diagnose.library import PPM, Group, Parameters
from training.diagnose.work import FloatArray, Work

HATS = (9, 21, 41)  # a smooth function, and ones that can bend within a few percent of the range
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
BENDING = frozenset({"temperature", "rate", "rate_times_temperature", "speed"})
TRANSITIONS = frozenset({"temperature", "rate_times_temperature"})
BUMPED = frozenset({"temperature", "rate_times_temperature", "rate", "speed", "time"})
WAVING = frozenset({"temperature", "rate_times_temperature", "rate", "time"})
CENTRES = 28
TRANSITION_WIDTHS = (0.012, 0.03, 0.08)  # shares of the driver's range
BUMP_WIDTHS = (0.013, 0.03, 0.07)
MOST_CYCLES = 24.0  # over the driver's range; finer waves are beyond what a driver is known to
CYCLE_STEP = 0.5
LEAST_SUPPORT = 0.05  # of an even share of the values, below which a corner is left out
HARMONICS = {"time": 2.0}  # what switches on and off by a clock of its own is no sine
ORDERS = range(1, 13)
CYCLIC: dict[str, tuple[str, frozenset[str]]] = {
    "heading": ("", frozenset({"heading"})),
    "rate_times_heading": ("w", frozenset({"heading", "rate"})),
}


def knots_of(values: FloatArray, count: int) -> FloatArray:
    """Corners: half by rank, half by range, so that neither crowded nor rare values are without one.

    A corner that next to no value is near is left out: between levels that stand apart nothing is known, and a value
    there would be made of the noise on them.
    """
    ranks = np.quantile(values, np.linspace(0.0, 1.0, count))
    knots = np.unique(0.5 * (ranks + np.linspace(ranks[0], ranks[-1], count)))
    if len(knots) < 3:
        return knots
    near = np.asarray([np.interp(values, knots, row).sum() for row in np.eye(len(knots))])
    near[[0, -1]] = np.inf
    return knots[near > LEAST_SUPPORT * len(values) / len(knots)]


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
        count = width_of(parameters) or len(sets[parameters["hats"]]) - 1
        return [(f"value_{i}", unit) for i in range(1, count + 1)]

    variants = [{"hats": n} for n in sets] + _shapes(driver, sets)
    return Group(driver, lambda survey: variants, columns, names, needs, knots=sets)


def width_of(parameters: Parameters) -> int:
    """How many columns a shape that is not made of hats has; 0 for hats."""
    if "cycle" in parameters:
        return 2 * int(parameters["harmonics"])
    return 1 if "centre" in parameters else 2 if "bump" in parameters else 0


def basis_of(values: FloatArray, sets: dict[float, FloatArray], parameters: Parameters) -> list[FloatArray]:
    """The basis functions of one variant at `values`: hats, or one of the shapes that hats are too blunt for.

    A transition at a value of the driver; a resonance there (even and odd part of a Lorentzian line, together any
    Fano line); a wave along the driver (`cycle` is its period).
    """
    if "centre" in parameters:
        return [0.5 * (1.0 + np.tanh((values - parameters["centre"]) / parameters["width"]))]
    if "bump" in parameters:
        x = (values - parameters["bump"]) / parameters["width"]
        return [1.0 / (1.0 + x * x), x / (1.0 + x * x)]
    if "cycle" in parameters:
        phase = 2.0 * np.pi * values / parameters["cycle"]
        orders = range(1, 1 + int(parameters["harmonics"]))
        return [wave(k * phase) for k in orders for wave in (np.cos, np.sin)]
    return hats(values, sets[parameters["hats"]])


def grain_of(parameters: Parameters) -> float | None:
    """The finest detail [driver units] of a shape that is not made of hats; None for hats."""
    if "cycle" in parameters:
        return parameters["cycle"] / 16.0
    return parameters.get("width")


def _shapes(driver: str, sets: dict[float, FloatArray]) -> list[Parameters]:
    """Transitions, resonances and waves across the driver's range, sharp to soft and slow to fast."""
    knots = next(iter(sets.values()))
    span = float(knots[-1] - knots[0])
    centres = np.linspace(knots[0] + 0.05 * span, knots[-1] - 0.05 * span, CENTRES)
    found: list[Parameters] = []
    for kind, drivers, widths in (
        ("centre", TRANSITIONS, TRANSITION_WIDTHS),
        ("bump", BUMPED, BUMP_WIDTHS),
    ):
        if driver in drivers:
            found += [
                {"hats": 0.0, kind: float(c), "width": float(share * span)}
                for share in widths
                for c in centres
            ]
    if driver in WAVING:
        harmonics = HARMONICS.get(driver, 1.0)
        cycles = np.arange(1.5, MOST_CYCLES + 0.1, CYCLE_STEP / harmonics)
        found += [{"hats": 0.0, "cycle": float(span / n), "harmonics": harmonics} for n in cycles]
    return found


def _cyclic_group(driver: str, prefix: str, needs: frozenset[str]) -> Group:
    def columns(work: Work, parameters: Parameters) -> list[FloatArray]:
        order = parameters["order"]
        wanted = (1, 2) if order < 0.5 else (int(order),)
        scale = PPM * work.full["w"] if prefix else 1.0
        psi = work.full["psi"]
        return [work.average(scale * wave(k * psi)) for k in wanted for wave in (np.cos, np.sin)]

    def names(parameters: Parameters) -> list[tuple[str, str]]:
        wanted = (1, 2) if parameters["order"] < 0.5 else (int(parameters["order"]),)
        return [(f"{kind}{k}", "ppm" if prefix else "dps") for k in wanted for kind in ("cos", "sin")]

    variants: list[Parameters] = [{"order": float(k)} for k in (0, *ORDERS)]
    return Group(driver, lambda survey: variants, columns, names, needs)
