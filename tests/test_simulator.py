import json

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from rtcomp.commands.simulate import command
from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.fog_format import RATE_ID, TEMPERATURE_ID
from rtcomp.model import OpenLoopSine, new_model
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map
from rtcomp.sources.candump import read_candump
from training.effects.base import ErrorEffect
from training.effects.catalogue import catalogue
from training.simulator.draw import Draw
from training.simulator.environment import housing_temperature, sensed, turned
from training.simulator.gyro import error_waveforms, surface_output
from training.simulator.motion import Chirp, Circles, Creep, Drive, Parking, Profile, Replay, Static, Steps
from training.simulator.on_recording import simulated_rate
from training.simulator.output import REFERENCE_ID, log_frames, write
from training.simulator.run import run, simulate
from training.simulator.scenario import (
    Environment,
    Gyro,
    Noise,
    Record,
    Scenario,
    Surface,
    Switch,
    Table,
    TemperatureSensor,
    bundled_scenarios,
    load_scenario,
)
from training.table import Recording, read_recording, write_recording

ERROR_IDS = [entry.id for entry in catalogue().values() if isinstance(entry, ErrorEffect)]
PERFECT = TemperatureSensor(lag_s=0.0, lsb_K=0.0, noise_K=0.0)
WARMING = Environment([(0.0, -10.0), (100.0, 30.0)], housing_tau_s=20.0)


def scenario(*switches, motion=None, surface="ideal", noise="none", **more):
    """Return two minutes of a drive at 20 Hz through rising temperatures with these effects on."""
    return Scenario(
        title="test",
        duration_s=more.pop("duration_s", 120.0),
        rate_hz=more.pop("rate_hz", 20.0),
        motion=motion or Drive(turns_per_min=8.0),
        environment=more.pop("environment", WARMING),
        gyro=Gyro(surface=surface, noise=noise, effects=list(switches)),
        **more,
    )


def test_same_seed_same_bits_other_seed_other_bits():
    noisy = scenario(Switch("timing_jitter"), noise=Noise())
    first, again, other = simulate(noisy, 5), simulate(noisy, 5), simulate(noisy, 6)
    assert all(np.array_equal(first[name], again[name]) for name in first.columns)
    assert not np.array_equal(first["rate_dps"], other["rate_dps"])
    assert not np.array_equal(first["ref_rate_dps"], other["ref_rate_dps"])


@pytest.mark.parametrize("name", ERROR_IDS)
def test_an_effect_alone_changes_the_rate_by_its_waveform_and_nothing_else(name):
    plain, concealed = run(scenario(noise=Noise())), run(scenario(Switch(name, case="hard"), noise=Noise()))
    wave = catalogue()[name].error(plain.truth, catalogue()[name].hard())
    difference = concealed.recording["rate_dps"] - plain.recording["rate_dps"]
    np.testing.assert_allclose(difference, wave, atol=1e-10)
    for column in set(plain.recording.columns) - {"rate_dps"}:
        assert np.array_equal(plain.recording[column], concealed.recording[column])


@pytest.mark.parametrize(
    "name", ["timestamp_skew", "bandwidth", "dead_band", "saturation", "unit_error", "noise_level"]
)
def test_a_measurement_chain_effect_changes_the_rate_only(name):
    plain, concealed = simulate(scenario()), simulate(scenario(Switch(name, case="hard")))
    changed = {column for column in plain.columns if not np.array_equal(plain[column], concealed[column])}
    assert changed <= {"rate_dps"}
    assert changed or name == "saturation"  # nothing saturates at 45 °/s


@pytest.mark.parametrize("case", ["nominal", "hard"])
@pytest.mark.parametrize("name", list(catalogue()))
def test_every_effect_can_be_switched_on_from_a_file(name, case, tmp_path):
    file = tmp_path / "one.toml"
    values = getattr(catalogue()[name], case)()
    given = ", ".join(f"{key} = {float(value)!r}" for key, value in values.items())
    motion = 'title = "one effect"\nrate_hz = 5.0\nmotion = {kind = "drive"}\n'
    file.write_text(motion + f'gyro = {{effects = [{{effect = "{name}", case = "{case}"}}]}}')
    by_case = simulate(load_scenario(file))
    file.write_text(motion + f'gyro = {{effects = [{{effect = "{name}", parameters = {{{given}}}}}]}}')
    by_value = simulate(load_scenario(file))
    for column, values in by_case.columns.items():
        assert np.array_equal(values, by_value[column])
        assert np.all(np.isfinite(values))


def test_waveforms_of_several_effects_add():
    switches = [Switch("shupe"), Switch("thermal_lag"), Switch("magnetic")]
    together = run(scenario(*switches))
    waves = error_waveforms(scenario(*switches).gyro, together.truth)
    assert list(waves) == ["shupe", "thermal_lag", "magnetic"]
    error = together.recording["rate_dps"] - together.truth.rate_dps
    np.testing.assert_allclose(error, sum(waves.values()), atol=1e-12)


def test_rate_table_has_the_figures_of_the_reference_gyro():
    """PHYSICS §4.3, mean of six seeds: max 11.61, rms 4.76; one seed within its soak-to-soak scatter."""
    table = simulate(load_scenario("rate_table"))
    error = table["rate_dps"] - table["ref_rate_dps"]
    assert len(table) == 648
    assert "t_s" not in table
    assert np.abs(error).max() == pytest.approx(11.61, abs=0.15)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(4.76, abs=0.05)


def test_surface_is_what_the_runtime_base_inverts():
    table = simulate(
        scenario(surface=Surface(), table=Table(soak_scale_ppm=0.0, read_noise_dps=0.0, lsb_dps=0.0))
    )
    base = OpenLoopSine(**{name: getattr(Surface(), name) for name in OpenLoopSine.__struct_fields__})
    predicted = predict(new_model(base=base), table["rate_dps"], table["temp_degC"]).error_dps
    np.testing.assert_allclose(table["rate_dps"] - predicted, table["ref_rate_dps"], atol=1e-9)


def test_surface_sensitivity_is_that_of_the_physics_notes():
    low = surface_output(Surface(), np.full(2, 1.0), np.array([25.0, 26.0]))
    assert low[0] == pytest.approx(1.041, abs=1e-4)
    assert (low[1] - low[0]) / low[0] * 1e6 == pytest.approx(-1263, abs=5)


def test_coil_lag_of_the_surface_equals_the_lag_effect_to_first_order():
    """Two ways to the same physics: optics at the coil, or optics at the housing plus the lag term."""
    quiet = {"motion": Profile([(0.0, 1.0)]), "duration_s": 1800.0, "rate_hz": 2.0, "sensor": PERFECT}
    environment = Environment([(0.0, 20.0), (1800.0, 30.0)], 150.0, [], [])
    at_coil = simulate(scenario(surface=Surface(at="coil"), environment=environment, **quiet))
    slope = -350.0 * 1.041 - 950.0
    lag = Switch("thermal_lag", {"tau_s": 280.0, "scale_ppm_per_K": slope})
    housing = simulate(scenario(lag, surface=Surface(at="housing"), environment=environment, **quiet))
    static = simulate(scenario(surface=Surface(at="housing"), environment=environment, **quiet))
    effect = np.abs(at_coil["rate_dps"] - static["rate_dps"]).max()
    assert np.abs(at_coil["rate_dps"] - housing["rate_dps"]).max() < 0.05 * effect


def test_housing_follows_the_ambient_and_heats_itself():
    t = np.arange(0.0, 20000.0, 10.0)
    housing = housing_temperature(t, Environment([(0.0, -20.0), (3000.0, 10.0)]))
    assert housing[0] == -20.0
    assert housing[-1] == pytest.approx(10.0 + 8.0, abs=0.01)
    assert abs(housing[1] - housing[0]) < 0.2  # no abrupt start


def test_temperature_sensor_lags_and_steps_by_its_lsb():
    t = np.arange(0.0, 3000.0, 1.0)
    ramp = 20.0 + t / 60.0
    reading = sensed(t, ramp, TemperatureSensor(lag_s=20.0, lsb_K=0.1, noise_K=0.0), np.random.default_rng(0))
    np.testing.assert_allclose(reading * 10, np.round(reading * 10), atol=1e-9)
    # six samples a step: rounding shifts the mean by half a sample, 1/120 K, at most
    assert np.mean(reading[500:] - ramp[500:]) == pytest.approx(-20.0 / 60.0, abs=1.01 / 120.0)


MOTIONS = [
    Static(),
    Profile([(0.0, 0.0), (60.0, 30.0)]),
    Steps([0.0, 30.0, -30.0], dwell_s=10.0),
    Chirp(),
    Creep(),
    Circles([20.0, -20.0], turns=1.0),
    Drive(),
    Parking(),
]


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_motion_turns_the_heading_and_stays_within_its_bounds(motion):
    truth = run(scenario(motion=motion)).truth
    assert np.all(np.isfinite(truth.rate_dps))
    np.testing.assert_allclose(
        np.gradient(truth.heading_deg, truth.t_s)[1:-1], _smoothed(truth.rate_dps), atol=1e-9
    )
    np.testing.assert_allclose(truth.accel_lat_mps2, truth.speed_mps * np.radians(truth.rate_dps))
    assert np.all(truth.speed_mps >= 0)
    assert np.abs(truth.accel_lat_mps2).max() < 6.0
    assert (np.abs(truth.rate_dps).max() > 0) == (not isinstance(motion, Static))


def _smoothed(rate):
    """Central difference of a trapezium sum: the mean of the two neighbouring means."""
    return (rate[:-2] + 2 * rate[1:-1] + rate[2:]) / 4


def test_circles_are_whole_turns_in_both_directions():
    t = np.arange(0, 60, 0.01)
    rate, _ = Circles([20.0, -20.0], turns=1.0, pause_s=4.0).path(t, np.random.default_rng(0))
    heading = turned(t, rate)
    assert heading.max() == pytest.approx(360.0, rel=1e-3)
    assert heading[t > 50][0] == pytest.approx(0.0, abs=1.0)


def test_a_drive_does_not_turn_while_it_stands():
    truth = run(scenario(motion=Drive(stops=0.6, stretch_s=15.0))).truth
    standing = truth.speed_mps == 0.0
    assert standing.any()
    assert not truth.rate_dps[standing].any()


def test_simulated_rate_repeats_the_gyro_on_its_own_recording():
    switches = [Switch("shupe"), Switch("scale_hysteresis"), Switch("timestamp_skew"), Switch("quantization")]
    gyro = scenario(*switches, surface=Surface(), sensor=TemperatureSensor(0.0, 0.0, 0.0, coil=True))
    recording = simulate(gyro)
    np.testing.assert_allclose(simulated_rate(gyro, recording), recording["rate_dps"], atol=1e-9)


def test_simulated_rate_follows_the_coil_from_the_housing_where_no_coil_is_recorded():
    gyro = scenario(surface=Surface(at="coil"), sensor=PERFECT)
    recording = simulate(gyro)
    assert "coil_temp_degC" not in recording
    np.testing.assert_allclose(simulated_rate(gyro, recording), recording["rate_dps"], atol=1e-9)


def test_simulated_rate_has_noise_only_when_asked():
    gyro = scenario(noise=Noise(), sensor=PERFECT)
    recording = simulate(gyro)
    np.testing.assert_allclose(simulated_rate(gyro, recording), recording["ref_rate_dps"], atol=1e-12)
    noisy = simulated_rate(gyro, recording, noise=True)
    assert np.array_equal(noisy, recording["rate_dps"])


def test_simulated_rate_on_a_table_and_at_standstill():
    soaked = Recording("points", {"rate_dps": np.zeros(3), "temp_degC": np.array([0.0, 25.0, 50.0])})
    still = simulated_rate(scenario(Switch("bias_temperature", {"b1_dps_per_K": 0.01})), soaked, static=True)
    np.testing.assert_allclose(still, [-0.25, 0.0, 0.25])
    with pytest.raises(RequestError, match="ref_rate_dps"):
        simulated_rate(scenario(), soaked)


def test_simulated_rate_bridges_gaps_and_names_a_missing_driver():
    recording = simulate(scenario(sensor=PERFECT))
    recording["temp_degC"][100:120] = np.nan
    lag = scenario(Switch("thermal_lag"))
    assert np.all(np.isfinite(simulated_rate(lag, recording)))
    del recording.columns["heading_deg"]
    with pytest.raises(RequestError, match="heading_deg"):
        simulated_rate(scenario(Switch("magnetic")), recording)


def test_the_simulation_column_leaves_out_what_the_other_scenario_leaves_out():
    lagging = scenario(surface=Surface(at="coil"), sensor=PERFECT, record=Record(simulation="soaked_gyro"))
    done = run(lagging)
    expected = surface_output(Surface(), done.truth.rate_dps, done.truth.temp_degC)
    np.testing.assert_allclose(done.recording["sim_rate_dps"], expected, atol=1e-9)


def test_replay_takes_truth_from_a_recording(tmp_path):
    write(run(scenario(sensor=PERFECT)), scenario(), tmp_path / "real.parquet")
    real = read_recording(tmp_path / "real.parquet")
    again = simulate(scenario(motion=Replay(str(tmp_path / "real.parquet")), sensor=PERFECT))
    assert len(again) == len(real)
    for column in ("t_s", "ref_rate_dps", "temp_degC", "speed_mps"):
        np.testing.assert_allclose(again[column], real[column], atol=1e-12)


def test_replay_of_a_rate_alone_takes_temperature_from_the_environment(tmp_path):
    t = 5.0 + np.arange(600) / 10.0
    rate = 20.0 * np.sin(t / 3.0)
    write_recording(Recording("bus", {"t_s": t, "rate_dps": rate}), tmp_path / "bus.csv")
    motion = Replay(str(tmp_path / "bus.csv"), truth="rate_dps", temperature="environment")
    again = run(scenario(Switch("magnetic"), motion=motion))
    np.testing.assert_allclose(again.recording["ref_rate_dps"], rate)
    np.testing.assert_allclose(again.recording["t_s"], t - 5.0)
    np.testing.assert_allclose(again.truth.temp_degC, housing_temperature(t - 5.0, WARMING))
    with pytest.raises(RequestError, match="ref_rate_dps"):
        run(scenario(motion=Replay(str(tmp_path / "bus.csv"))))


def test_a_table_refuses_what_acts_in_time():
    for name in ("timestamp_skew", "dropped_frames", "bandwidth", "noise_level"):
        with pytest.raises(RequestError, match=name):
            simulate(scenario(Switch(name), table=Table()))
    with pytest.raises(RequestError, match="heading_deg"):
        simulate(scenario(Switch("magnetic"), table=Table()))


def test_log_carries_rates_temperatures_and_lost_counters(tmp_path):
    lossy = scenario(Switch("dropped_frames", {"fraction": 0.02}), sensor=TemperatureSensor(coil=True))
    done = run(lossy)
    count = write(done, lossy, tmp_path / "drive.log")
    frames = np.concatenate(list(read_candump(tmp_path / "drive.log")))
    assert np.array_equal(frames, log_frames(done, lossy))
    assert len(frames) == count
    assert np.all(np.diff(frames["t_ns"]) >= 0)
    rate = frames[frames["can_id"] == RATE_ID]
    decoded = np.ascontiguousarray(rate["data"][:, 2:6]).view("<i4").ravel() * 1e-6
    np.testing.assert_allclose(decoded, done.recording["rate_dps"], atol=0.51e-6)
    reference = frames[frames["can_id"] == REFERENCE_ID]
    decoded = np.ascontiguousarray(reference["data"][:, 2:6]).view("<i4").ravel() * 1e-6
    np.testing.assert_allclose(decoded, done.sent["ref_rate_dps"], atol=0.51e-6)
    assert np.array_equal(rate["data"][:, 1] & 0xF, done.slot % 15)
    assert len(rate) < len(reference)
    temperature = frames[frames["can_id"] == TEMPERATURE_ID]
    housing = np.ascontiguousarray(temperature["data"][:, 2:4]).view("<i2").ravel() * 0.01
    assert np.abs(housing - np.interp((temperature["t_ns"] - frames["t_ns"][0]) * 1e-9, done.sent["t_s"],
                                      done.sent["temp_degC"])).max() < 0.0051  # fmt: skip


def test_log_of_the_demo_goes_through_the_bundled_map_unflagged():
    drive = load_scenario("demo_drive")
    done = run(drive)
    base = OpenLoopSine(**{name: getattr(Surface(), name) for name in OpenLoopSine.__struct_fields__})
    pipeline = Pipeline(compile_map(load_map("fog_simulated")), {"yaw": [new_model(base=base)]})
    samples = pipeline.process_all(log_frames(done, drive)).corrected
    np.testing.assert_allclose(samples["rate_raw_dps"], done.recording["rate_dps"], atol=0.51e-6)
    np.testing.assert_allclose(samples["ref_rate_dps"], done.recording["ref_rate_dps"], atol=0.51e-6)
    assert not samples["flags"].any()
    before, after = (np.std(samples[name] - samples["ref_rate_dps"]) for name in ("rate_raw_dps", "rate_dps"))
    assert after < before / 50


def test_a_frozen_frame_repeats_its_bytes_in_a_log():
    frozen = scenario(Switch("frozen_frames", {"events_per_h": 600.0, "duration_s": 1.0}))
    done = run(frozen)
    frames = log_frames(done, frozen)
    rate = frames[frames["can_id"] == RATE_ID]
    repeats = np.all(rate["data"][1:] == rate["data"][:-1], axis=1)
    assert np.array_equal(repeats, np.diff(done.source) == 0)
    assert repeats.sum() > 20


def test_every_bundled_scenario_runs():
    promised = (
        "rate_table chamber_cycle cold_start_drive parking creep heading_circles demo_drive paper_omission"
    )
    assert set(promised.split()) <= set(bundled_scenarios())
    for name in bundled_scenarios():
        short = msgspec.structs.replace(load_scenario(name), rate_hz=2.0)
        recording = simulate(short)
        assert all(np.all(np.isfinite(values)) for values in recording.columns.values())


def test_demo_drive_shows_a_temperature_ramp_and_several_degrees_a_second_of_error():
    recording = simulate(load_scenario("demo_drive"))
    error = recording["rate_dps"] - recording["ref_rate_dps"]
    assert 60 <= np.ptp(recording["t_s"]) <= 120
    assert np.ptp(recording["temp_degC"]) > 30
    assert np.abs(error).max() > 4
    static = simulated_rate(load_scenario("soaked_gyro"), recording) - recording["ref_rate_dps"]
    assert np.std(error - static) < 0.02 * np.std(error)  # a soaked model corrects it


def test_paper_omission_leaves_thermal_lag_to_the_soaked_model():
    recording = simulate(load_scenario("paper_omission"))
    left = recording["rate_dps"] - recording["sim_rate_dps"]
    assert np.std(left) > 5 * 0.05 / 60 * np.sqrt(20.0)  # far above the white noise at 20 Hz


def test_strict_scenarios(tmp_path):
    file = tmp_path / "s.toml"
    cases = {
        'title = "x"\nspeed = 3': "speed",
        'title = "x"\nseed = -1': "seed",
        "seed = 1": "title",
        'title = "x"\nmotion = {kind = "flight"}': "flight",
        'title = "x"\ngyro = {effects = [{effect = "gremlin"}]}': "gremlin",
        'title = "x"\ngyro = {effects = [{effect = "shupe", parameters = {tau = 3.0}}]}': "tau",
        'title = "x"\nenvironment = {ambient_degC = [[5.0, 1.0], [1.0, 2.0]]}': "rise",
        'title = "x"\nenvironment = {self_heating_K = [1.0]}': "self_heating",
        'title = "x"\nduration_s = 0.001': "lengthen",
        'title = "x': "scenario",
    }
    for text, reason in cases.items():
        file.write_text(text)
        with pytest.raises(RequestError, match=reason):
            load_scenario(file)
    with pytest.raises(RequestError, match="demo_drive"):
        load_scenario("no_such_thing")


def test_command_writes_the_same_file_for_the_same_seed(tmp_path):
    files = [tmp_path / "a.csv.gz", tmp_path / "b.csv.gz", tmp_path / "c.csv.gz"]
    told = []
    for file, seed in zip(files, ("3", "3", "4"), strict=True):
        result = CliRunner().invoke(command, ["demo_drive", "-o", str(file), "--seed", seed, "--json"])
        assert result.exit_code == 0, result.output
        told.append(json.loads(result.output.splitlines()[-1]))
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()
    recording = read_recording(files[0])
    assert told[0]["rows"] == len(recording) == 9000
    assert told[0]["simulated"] is True
    error = recording["rate_dps"] - recording["ref_rate_dps"]
    assert told[0]["rms_error_dps"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)


def test_command_tells_a_person_and_refuses_an_unknown_ending(tmp_path):
    said = CliRunner().invoke(command, ["rate_table", "-o", str(tmp_path / "t.csv")])
    assert said.exit_code == 0
    assert "simulated, seed 1" in said.output
    for name, output in (("demo_drive", "x.xlsx"), ("rate_table", "x.log")):
        refused = CliRunner().invoke(command, [name, "-o", str(tmp_path / output)])
        assert isinstance(refused.exception, RequestError)
        assert not (tmp_path / output).exists()


def test_draws_of_different_purposes_are_independent():
    draws = [
        Draw(1).of(name).standard_normal(20_000) for name in ("gyro noise", "temperature sensor", "road")
    ]
    assert np.abs(np.corrcoef(draws) - np.eye(3)).max() < 0.03


def test_the_noise_of_a_scenario_has_the_names_of_its_effect():
    catalogue()["noise_level"].complete(Noise().values())
    assert tuple(Noise().values().values()) == Noise().density


def test_the_catalogue_is_listed_with_units_and_sources():
    shown = CliRunner().invoke(command, ["--effects"])
    assert shown.exit_code == 0
    for name, entry in catalogue().items():
        assert f"\n{name}: {entry.title}\n  {entry.equation}\n" in f"\n{shown.output}"
        assert all(f"  {p} [{what.unit}]" in shown.output for p, what in entry.parameters.items())


def test_help_names_every_bundled_scenario():
    shown = CliRunner().invoke(command, ["--help"]).output
    assert all(name in shown for name in bundled_scenarios())
