"""One recording from its columns to what the search works on: checked, simulated, aligned, averaged."""

from dataclasses import dataclass

import numpy as np

from rtcomp.errors import RequestError
from training.diagnose.align import Timing, align
from training.diagnose.checked import Checked
from training.diagnose.fast import (
    FastFinding,
    VarianceModel,
    line_finding,
    quantization_finding,
    variance_model,
)
from training.diagnose.integrity import check
from training.diagnose.orders import without_orders
from training.diagnose.prepare import prepare
from training.diagnose.reference import Reference, cleared, reference, unbiased
from training.diagnose.settings import Settings
from training.diagnose.simulation import Simulation
from training.diagnose.surface import Surface, stand_on
from training.diagnose.work import FloatArray, Work
from training.table import Recording


@dataclass
class Intake:
    """A recording ready for the search; `residual` is measured − simulated at full rate [dps]."""

    recording: Recording
    checked: Checked
    residual: FloatArray
    simulated: FloatArray
    reference: Reference | None
    timing: Timing
    fast: list[FastFinding]
    work: Work
    driving: FloatArray
    surface: Surface | None = None

    @property
    def simulated_error(self) -> FloatArray:
        """Temperature [degC], true rate and simulated error [dps] of the sound rows, `(3, n)`; none without time."""
        columns = self.checked.columns
        if not {"temp_degC", "t_s"} <= set(columns):
            return np.empty((3, 0))
        rows = np.stack([columns["temp_degC"], self.driving, self.simulated - columns["ref_rate_dps"]])
        return rows[:, self.checked.valid & np.isfinite(rows).all(axis=0)]

    def stand_on(self, surface: Surface | None) -> None:
        """Let the regressors ask what the simulation would say of another temperature."""
        self.surface = surface
        stand_on(surface, self.work)

    @property
    def rate(self) -> FloatArray:
        """True rate as regressors use it, at full rate."""
        return self.timing.moved

    @property
    def timing_change(self) -> FloatArray:
        """What the found timing adds to the measured rate, at full rate [dps]."""
        base = self.reference.rate if self.reference is not None else self.rate
        return self.timing.moved - base


def truth_or_error(recording: Recording, static: bool) -> None:
    """Refuse a recording that has nothing to compare with."""
    if "ref_rate_dps" not in recording and not static:
        raise RequestError(
            f"{recording.name}: no ref_rate_dps to compare with; record a reference, rename a column with "
            "--columns ref_rate_dps=NAME, or say --static if the unit did not turn"
        )
    if "rate_dps" not in recording:
        raise RequestError(f"{recording.name}: no rate_dps; rename a column with --columns rate_dps=NAME")


def take_in(
    recording: Recording,
    checked: Checked,
    simulation: Simulation,
    settings: Settings,
    timing: Timing | None = None,
) -> Intake:
    """Simulate, align and average one checked recording; a given `timing` is applied instead of being fitted."""
    columns, valid = checked.columns, checked.valid
    simulated = simulation.rate(recording.name, columns, settings.static, settings.power_on_known)
    residual = np.where(valid, columns["rate_dps"] - simulated, 0.0)
    truth = np.where(np.isfinite(columns["ref_rate_dps"]), columns["ref_rate_dps"], 0.0)
    if "t_s" not in columns:
        work = prepare(recording.name, columns, residual, np.zeros_like(truth), truth, valid)
        return Intake(recording, checked, residual, simulated, None, Timing(moved=truth), [], work, truth)
    t = columns["t_s"]
    filled = _bridged(residual, valid)
    temp = columns.get("temp_degC")

    def clear(values: FloatArray) -> FloatArray:
        return without_orders(cleared(values, t, truth, temp, valid)[0], truth, columns, valid)

    quick, gain = clear(filled), cleared(filled, t, truth, temp, valid)[1]
    smoothed = reference(t, truth, quick)
    ref = unbiased(smoothed, quick, gain)
    names = settings.left_out
    found = align(columns, filled, ref, valid, clear, None, names) if timing is None else timing.applied(ref)
    left = filled - (found.moved - ref.rate)
    tested = clear(left) if found.effects else quick
    quantized = quantization_finding(columns["rate_dps"], left, valid, smoothed.noise_dps)
    line = line_finding(tested, truth, t, valid)  # the smoothed one has a share of the residual's lines
    fast = [f for f in (quantized, line) if f is not None]
    variance = VarianceModel() if quantized is not None else variance_model(tested, found.moved, t, valid)
    spread = variance.spread(found.moved, t) if variance.rate + variance.slope > 0.0 else None
    if spread is not None:
        ref = unbiased(smoothed, tested, gain, spread)
        found = (
            align(columns, filled, ref, valid, clear, spread, names)
            if timing is None
            else timing.applied(ref)
        )
        left = filled - (found.moved - ref.rate)
    fast += [variance.finding] if variance.finding is not None else []
    driving = found.moved
    if found.effects:  # without the timing error in it the residual shows the reference's noise more clearly
        driving = found.moved + unbiased(smoothed, tested, gain, spread).rate - ref.rate
    work = prepare(
        recording.name,
        columns,
        left,
        np.zeros_like(left),
        driving,
        valid,
        power_on_known=settings.power_on_known,
    )
    lsb = quantized.parameters["lsb_dps"][0] if quantized is not None else 0.0
    work.rate_noise_dps = max(ref.left_dps, lsb)
    if spread is not None:
        work.spread = np.sqrt(work.average(spread**2))
    return Intake(recording, checked, residual, simulated, ref, found, fast, work, driving)


def fast_findings(intake: Intake, wave: FloatArray) -> list[FastFinding]:
    """What full-rate samples show once the named errors `wave` `(n,)` [dps] are taken from them."""
    columns, valid, rate = intake.checked.columns, intake.checked.valid, intake.rate
    left = _bridged(intake.residual, valid) - intake.timing_change - wave
    truth = np.nan_to_num(columns["ref_rate_dps"])
    quick, _ = cleared(left, columns["t_s"], truth, columns.get("temp_degC"), valid)
    tested = without_orders(quick, truth, columns, valid)
    found = (
        quantization_finding(
            columns["rate_dps"], left, valid, intake.reference.noise_dps if intake.reference else 0.0
        ),
        line_finding(tested, truth, columns["t_s"], valid),
        variance_model(tested, rate, columns["t_s"], valid).finding,
    )
    return [f for f in found if f is not None]


def _bridged(values: FloatArray, valid: np.ndarray) -> FloatArray:
    if valid.all():
        return values
    index = np.arange(len(values))
    return np.interp(index, index[valid], values[valid]) if valid.any() else values


def full_work(intake: Intake, power_on_known: bool) -> Work:
    """The working view at the recording's own rows, to predict an effect on each of them."""
    columns = intake.checked.columns
    everything = np.ones(len(intake.rate), dtype=bool)
    work = prepare(
        intake.recording.name,
        columns,
        intake.residual,
        np.zeros_like(intake.rate),
        intake.driving,
        everything,
        power_on_known=power_on_known,
        max_blocks=10_000_000,
    )
    stand_on(intake.surface, work)
    return work


def checked_recording(recording: Recording, static: bool) -> Checked:
    """Integrity checks of one recording, after making sure that there is a truth."""
    truth_or_error(recording, static)
    return check(dict(recording.columns), static)
