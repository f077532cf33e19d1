"""What several test files use."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from rtcomp import fog_format
from rtcomp.model import Rules, Term, new_model
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map

START_NS = 1_767_225_600_000_000_000
settings.register_profile("untimed", deadline=None)  # a first call compiles, and machines are busy
settings.load_profile("untimed")
RECORDINGS = Path(__file__).parents[2] / "shared" / "recordings"


@pytest.fixture(scope="session")
def recordings():
    """The folder of real recordings beside the checkout."""
    if not RECORDINGS.is_dir():
        pytest.skip(f"real recordings are not at {RECORDINGS}")
    return RECORDINGS


@pytest.fixture(scope="session")
def fog_map():
    return compile_map(load_map("fog"))


@pytest.fixture(scope="session")
def ts_model():
    """A hand-written TS model of four rules."""
    rules = Rules(
        centers=[[-10.0, -90.0], [-10.0, 90.0], [40.0, -90.0], [40.0, 90.0]],
        widths=[[25.0, 80.0], [20.0, 70.0], [30.0, 60.0], [25.0, 90.0]],
        consequents=[[0.1, 0.01, 0.02], [0.2, -0.02, 0.01], [-0.1, 0.02, 0.03], [0.05, 0.01, -0.02]],
    )
    limits = {"temp_degC": (-40.0, 70.0), "rate_dps": (-200.0, 200.0)}
    return new_model(inputs=["temp_degC", "rate_dps"], rules=rules, validity=limits, residual_std_dps=0.03)


@pytest.fixture(scope="session")
def lag_model(ts_model):
    """The same with a thermal lag on top."""
    import msgspec

    lag = Term("thermal_lag", {"tau_s": 280.0, "scale_ppm_per_K": -1263.0})
    return msgspec.structs.replace(ts_model, terms=[lag])


@pytest.fixture(scope="session")
def fog_frames():
    """A function that makes FOG frames: 100 Hz rate, 10 Hz temperature, seeded."""

    def make(seconds=20.0, seed=0, rate_hz=100.0):
        random = np.random.default_rng(seed)
        t_ns = START_NS + (np.arange(round(seconds * rate_hz)) * (1e9 / rate_hz)).astype(np.int64)
        rate = 100.0 * np.sin(np.arange(len(t_ns)) / 150.0) + random.normal(0, 0.1, len(t_ns))
        slow = t_ns[::10]
        housing = 20.0 + 10.0 * np.sin(np.arange(len(slow)) / 60.0)
        temperature = fog_format.encode_temperature(slow, housing, housing - 1.0)
        return fog_format.merge(temperature, fog_format.encode_rate(t_ns, rate))

    return make
