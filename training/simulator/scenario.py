"""What a scenario says: motion, temperatures, gyro with its effects, sensors and what is recorded.

Strict TOML: an unknown key, a wrong type or an unknown effect is refused with its place. Times count from
power-on. Without an entry the gyro is the reference gyro of PHYSICS.md §4.2 and §4.4.
"""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct, field

from rtcomp.errors import RequestError
from training.effects.catalogue import effect
from training.simulator.motion import Motion, Static

BUNDLED = Path(__file__).parent.parent / "scenarios"

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]


class Environment(Struct, frozen=True, forbid_unknown_fields=True):
    """Ambient temperature as a polyline [s, °C], the housing that follows it, and its own heat."""

    ambient_degC: Annotated[list[tuple[float, float]], Meta(min_length=1)] = field(
        default_factory=lambda: [(0.0, 25.0)]
    )
    housing_tau_s: NotNegative = 150.0  # two equal poles: no real housing starts to warm abruptly
    self_heating_K: list[float] = field(default_factory=lambda: [5.0, 3.0])
    self_heating_tau_s: list[Positive] = field(default_factory=lambda: [420.0, 1700.0])


class TemperatureSensor(Struct, frozen=True, forbid_unknown_fields=True):
    """The housing sensor: first-order lag, noise and least significant bit; `coil` adds one at the coil."""

    lag_s: NotNegative = 20.0
    lsb_K: NotNegative = 0.1
    noise_K: NotNegative = 0.02
    coil: bool = False


class Surface(Struct, frozen=True, forbid_unknown_fields=True):
    """Open loop, m = G(T)·sin(K(T)·ω)/K0, K = K0(1 + αh), G = 1 + g0 + g1·h + g2·h² (PHYSICS.md §4.2)."""

    kind: Literal["open_loop_sine"] = "open_loop_sine"
    at: Literal["coil", "housing"] = "coil"  # which temperature the optics have
    K0_s: Positive = 0.178
    alpha_per_K: float = -350e-6
    g0: float = 0.041
    g1_per_K: float = -950e-6
    g2_per_K2: float = 1.5e-6
    ref_degC: float = 25.0


class Noise(Struct, frozen=True, forbid_unknown_fields=True):
    """Noise model of the gyro itself (PHYSICS.md F1)."""

    arw_deg_rt_h: NotNegative = 0.05
    bias_instability_deg_h: NotNegative = 0.5
    rrw_deg_h_rt_h: NotNegative = 1.0

    @property
    def density(self) -> tuple[float, float, float]:
        """(N [°/√h], B [°/h], R [°/h/√h])."""
        return self.arw_deg_rt_h, self.bias_instability_deg_h, self.rrw_deg_h_rt_h

    def values(self) -> dict[str, float]:
        """Return the model under the parameter names of the effect noise_level."""
        return msgspec.structs.asdict(self)


class Switch(Struct, frozen=True, forbid_unknown_fields=True):
    """One effect that is on: by its own parameters, or as the catalogue's nominal (or hard) case."""

    effect: str
    parameters: dict[str, float] = {}
    case: Literal["nominal", "hard"] = "nominal"

    def values(self) -> dict[str, float]:
        """Return the parameters that act; RequestError for unknown effects or parameters."""
        entry = effect(self.effect)
        if not self.parameters:
            return entry.nominal() if self.case == "nominal" else entry.hard()
        entry.complete(self.parameters)
        return dict(self.parameters)


class Gyro(Struct, frozen=True, forbid_unknown_fields=True):
    """The gyro: its optics, the lag of its coil behind the housing, its noise and the effects that are on."""

    surface: Literal["ideal"] | Surface = field(default_factory=Surface)
    coil_tau_s: NotNegative = 280.0
    coil_tau2_s: NotNegative = 0.0
    noise: Literal["none"] | Noise = "none"
    effects: list[Switch] = []


class Table(Struct, frozen=True, forbid_unknown_fields=True):
    """A rate-table run of soaked averages (PHYSICS.md §4.2); replaces motion and environment."""

    temps_degC: Annotated[list[float], Meta(min_length=1)] = field(
        default_factory=lambda: [float(temp) for temp in range(-30, 60, 5)]
    )
    rates_dps: Annotated[list[float], Meta(min_length=1)] = field(
        default_factory=lambda: [float(rate) for rate in range(-180, 190, 10) if rate]
    )
    average_s: Positive = 600.0  # 1000 samples of 0.6 s
    soak_s: NotNegative = 7200.0
    soak_scale_ppm: NotNegative = 280.0  # 1σ, common to all rates of one soak
    read_noise_dps: NotNegative = 0.006  # 1σ of one averaged point
    lsb_dps: NotNegative = 0.001


class Record(Struct, frozen=True, forbid_unknown_fields=True):
    """What is written down besides time, rate and temperature."""

    reference: bool = True
    reference_noise_dps: NotNegative = 0.0
    drivers: bool = True  # heading, speed, lateral acceleration, vibration
    counter_modulus: Annotated[int, Meta(ge=0)] = 256  # 0: no counter
    simulation: str = ""  # name or file of the scenario whose output goes into sim_rate_dps
    temperature_period_s: Positive = 0.1  # of temperature frames in a CAN log


class Scenario(Struct, frozen=True, forbid_unknown_fields=True):
    """One simulated experiment."""

    title: str
    seed: Annotated[int, Meta(ge=0)] = 1
    duration_s: Positive = 600.0
    rate_hz: Positive = 100.0
    motion: Motion = field(default_factory=Static)
    environment: Environment = field(default_factory=Environment)
    sensor: TemperatureSensor = field(default_factory=TemperatureSensor)
    gyro: Gyro = field(default_factory=Gyro)
    record: Record = field(default_factory=Record)
    table: Table | None = None


def bundled_scenarios() -> list[str]:
    """Return the names of the scenarios that come with the package."""
    return sorted(path.stem for path in BUNDLED.glob("*.toml"))


def load_scenario(name: str | Path) -> Scenario:
    """Read a scenario by bundled name or file.

    Raises RequestError for a missing file, text that is not TOML, unknown keys, effects or parameters.
    """
    path = Path(name)
    if not path.is_file() and (BUNDLED / f"{name}.toml").is_file():
        path = BUNDLED / f"{name}.toml"
    if not path.is_file():
        raise RequestError(
            f"no scenario {str(name)!r}; give a TOML file or one of {', '.join(bundled_scenarios())}"
        )
    try:
        scenario = msgspec.toml.decode(path.read_bytes(), type=Scenario)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RequestError(f"{path}: not a scenario: {error}") from error
    check(scenario, str(path))
    return scenario


def check(scenario: Scenario, where: str) -> None:
    """Refuse what the types cannot: unknown effects or parameters, times that do not rise, unequal lists."""
    for switch in scenario.gyro.effects:
        try:
            switch.values()
        except RequestError as error:
            raise RequestError(f"{where}: {error}") from error
    times = [time for time, _ in scenario.environment.ambient_degC]
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise RequestError(f"{where}: times of environment.ambient_degC do not rise: {times}; sort them")
    heat = scenario.environment
    if len(heat.self_heating_K) != len(heat.self_heating_tau_s):
        raise RequestError(
            f"{where}: {len(heat.self_heating_K)} self_heating_K but {len(heat.self_heating_tau_s)} "
            "self_heating_tau_s; give one time constant per amplitude"
        )
    if scenario.table is None and scenario.duration_s * scenario.rate_hz < 2.0:
        raise RequestError(
            f"{where}: {scenario.duration_s} s at {scenario.rate_hz} Hz is no sample; lengthen it"
        )
