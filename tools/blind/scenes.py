"""A scene: everything true about one recording before any gyro error is put into it."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.fft import next_fast_len

from tools.blind.climates import STEP_S, Climate, make_climate
from tools.blind.motions import MOTIONS, Motion
from tools.blind.noise import Noise, SoakNoise, basis, draw_noise
from tools.blind.thermal import Coil, conduct


@dataclass
class Scene:
    """True state at the samples of one recording.

    Attributes:
        kind: "motion/climate", or "averages" for rate-table points without time.
        t_s: shape (n,), from power-on; for averages the row number.
        omega_dps: true rate, shape (n,).
        temp_degC: temperature of the gyro's sensor without noise, shape (n,).
        gyro_noise: of the gyro alone.
        noise: of measured minus simulated: with the reference's noise where the simulation is the reference.
        reference_dps: white noise of the reference.
        motion, climate: finer grids; None for averages.
    """

    kind: str
    t_s: np.ndarray
    omega_dps: np.ndarray
    temp_degC: np.ndarray
    gyro_noise: Noise
    noise: Noise
    reference_dps: float
    motion: Motion | None = None
    climate: Climate | None = None
    heading_deg: np.ndarray | None = None
    vibration: np.ndarray | None = None
    coils: dict[tuple[float, ...], Coil] = field(default_factory=dict)
    free: dict[bool, np.ndarray] = field(default_factory=dict)

    @property
    def timed(self) -> bool:
        """Whether the rows have a time."""
        return self.motion is not None

    @property
    def dt_s(self) -> float:
        """Sampling interval [s]."""
        return float(self.t_s[1] - self.t_s[0])

    @property
    def duration_s(self) -> float:
        """Length of the recording [s]."""
        return float(self.t_s[-1])

    def road(self) -> Motion:
        """The motion; ValueError for averages, which have none."""
        if self.motion is None:
            raise ValueError("rate-table averages have no motion; plant static effects only")
        return self.motion

    def weather(self) -> Climate:
        """The climate; ValueError for averages, which have none."""
        if self.climate is None:
            raise ValueError("rate-table averages have no climate; plant static effects only")
        return self.climate

    def coil(self, thickness_m: float, kappa: float, hub: float) -> Coil:
        """Coil temperatures for a winding, solved once per scene and winding."""
        key = (thickness_m, kappa, hub)
        if key not in self.coils:
            self.coils[key] = conduct(self.weather().housing_degC, STEP_S, *key)
        return self.coils[key]

    def sampled(self, on_grid: np.ndarray) -> np.ndarray:
        """A series on the climate's grid at the recording's samples, shape (n,)."""
        return np.interp(self.t_s, self.weather().grid_s, on_grid)

    def nuisance(self, delay: bool = True) -> np.ndarray:
        """Columns an estimator must give away: offset, scale and (unless delay is the point) delay, shape (n, m)."""
        columns = [np.ones(len(self.t_s)), self.omega_dps]
        if delay and self.motion is not None:
            columns.append(self.motion.rate(self.t_s, 1))
        return np.column_stack([c for c in columns if np.any(c)])

    def signature(self, waveform_dps: np.ndarray, delay: bool = True) -> np.ndarray:
        """Whitened waveform beyond the nuisance, shape (n,): its norm is d′."""
        if delay not in self.free:
            self.free[delay] = basis(self.noise.whiten(self.nuisance(delay)))
        whitened, q = self.noise.whiten(waveform_dps), self.free[delay]
        return whitened - q @ (q.T @ whitened)


def make_scene(
    kind: str,
    duration_s: float,
    fs_hz: float,
    grade: float,
    rng: np.random.Generator,
    simulated: bool = False,
) -> Scene:
    """A timed scene of kind "motion/climate", or averages (duration and rate are then ignored).

    With `simulated` there is a simulation besides the reference, so that the reference's noise does not matter.
    """
    if kind == "averages":
        return make_averages(rng)
    moving, surroundings = kind.split("/")
    motion = MOTIONS[moving](duration_s, fs_hz, rng)
    climate = make_climate(surroundings, duration_s, rng)
    t = np.arange(int(next_fast_len(int(0.97 * duration_s * fs_hz)) or 0)) / fs_hz
    reference = 0.0 if moving == "zero" else float(np.exp(rng.uniform(np.log(2e-3), np.log(3e-2))))
    gyro = draw_noise(rng, 1 / fs_hz, grade)
    noise = gyro if simulated else replace(gyro, white_dps=float(np.hypot(gyro.white_dps, reference)))
    omega = np.asarray(motion.rate(t))
    temp = np.interp(t, climate.grid_s, climate.housing_degC)
    scene = Scene(kind, t, omega, temp, gyro, noise, reference, motion, climate)
    if moving in ("circles", "drive", "table"):
        turned = motion.rate.antiderivative()
        scene.heading_deg = np.mod(rng.uniform(0, 360) + turned(t) - turned(0.0), 360)
    if motion.speed is not None:
        scene.vibration = _shaking(np.interp(t, motion.grid_s, motion.speed), t, rng)
    return scene


def _shaking(speed: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """RMS vibration [m/s²]: idle plus speed, times a road surface that changes at random."""
    changes = np.cumsum(rng.exponential(120, int(t[-1] / 120) + 5))
    surface = rng.choice([0.5, 1.0, 2.2], len(changes) + 1)[np.searchsorted(changes, t)]
    return 0.08 + 0.03 * speed * surface


def make_averages(rng: np.random.Generator) -> Scene:
    """Rate-table averages: every soak temperature with every rate, in the order they were taken."""
    temps = np.arange(rng.uniform(-32, -28), 58, rng.choice([5.0, 6.0, 7.0]))
    step = float(rng.choice([10.0, 15.0, 20.0]))
    rates = np.arange(step, 181, step)
    rates = np.concatenate([-rates[::-1], rates])
    omega, temp = np.tile(rates, len(temps)), np.repeat(temps, len(rates))
    soak = np.repeat(np.arange(len(temps)), len(rates))
    temp = temp + rng.normal(0, 0.15, len(temps))[soak]
    noise = SoakNoise(float(rng.uniform(0.003, 0.01)), float(rng.uniform(5, 60)), omega, soak)
    return Scene("averages", np.arange(len(omega), dtype=float), omega, temp, noise, noise, 0.0)


def white_variance(scene: Scene) -> float:
    """Variance of the white part per sample [(°/s)²], the floor that a variance effect rises above."""
    return scene.noise.white_dps**2
