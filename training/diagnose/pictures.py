"""The report's pictures as data URIs: time strip, driver plots, Allan deviation, held-out misfit."""

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from training.diagnose.document import Diagnosis, Finding
from training.diagnose.pipeline import Analysis, residual_after
from training.diagnose.prove import cleared
from training.diagnose.refit import driver_values
from training.diagnose.work import FloatArray, smooth

BEFORE, AFTER, MARK = "#c0392b", "#1f6f8b", "#f4d58d"
UNITS = {
    "temperature": "°C",
    "temperature_rate": "K/s",
    "rate": "°/s",
    "angular_acceleration": "°/s²",
    "time": "s",
    "time_since_power_on": "s",
    "heading": "°",
    "speed": "m/s",
    "acceleration": "g",
    "vibration": "(m/s²)²",
}


def data_uri(figure: Any) -> str:
    """A figure as a PNG data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _figure(rows: int, height: float, columns: int = 1) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _curves(analysis: Analysis, index: int) -> tuple[FloatArray, FloatArray]:
    work = analysis.intakes[index].work
    before = cleared(work.y, work.w, np.ones(len(work), dtype=bool))
    return before, residual_after(analysis, index)


def time_strips(analysis: Analysis, diagnosis: Diagnosis) -> str:
    """Error over time before and after, smoothed to what the eye can follow, with the located segments."""
    count = min(len(analysis.intakes), 4)
    figure, axes = _figure(count, 2.3)
    for index in range(count):
        axis, work = axes[index][0], analysis.intakes[index].work
        width = 1.0 if work.points else len(work) * work.step_s / 300.0
        for values, colour, label in zip(
            _curves(analysis, index), (BEFORE, AFTER), ("before", "after"), strict=True
        ):
            shown = values if work.points else smooth(values, work.step_s, width)
            axis.plot(work.t, shown, color=colour, lw=0.9, label=label)
        for finding in diagnosis.findings[:1]:
            for start, end in finding.where.segments[index] if index < len(finding.where.segments) else []:
                axis.axvspan(start, end, color=MARK, alpha=0.45, lw=0)
        axis.set_title(
            f"{analysis.intakes[index].recording.name}: error against the simulation (offset and scale removed)",
            fontsize=9,
        )
        axis.set_ylabel("°/s")
        axis.set_xlabel("row" if work.points else "t [s]")
        axis.grid(True, alpha=0.2)
        axis.legend(loc="upper left", fontsize=8, ncols=2)
        if not work.points:
            other = axis.twinx()
            other.plot(work.t, work.temp, color="0.6", lw=0.8, ls="--")
            other.set_ylabel("temperature [°C]", color="0.5")
            other.tick_params(axis="y", colors="0.5")
    return data_uri(figure)


def driver_unit(name: str) -> str:
    """Unit of a driver's values; of a rate-times driver it is that of the second factor."""
    return UNITS.get(name.removeprefix("rate_times_"), "1")


def driver_word(name: str) -> str:
    """What a driver's values are; of a rate-times driver the second factor."""
    return name.removeprefix("rate_times_").replace("_", " ")


def driver_label(name: str) -> str:
    """A driver's axis title."""
    return f"{driver_word(name)} [{driver_unit(name)}]"


def driver_plots(analysis: Analysis, diagnosis: Diagnosis) -> str | None:
    """Mean error over each located driver, before and after, with the regimes marked."""
    names = list(
        dict.fromkeys(
            [f.driver for f in diagnosis.findings] + [d.driver for d in diagnosis.drivers if d.p_value < 0.01]
        )
    )
    shown = [n for n in names if driver_values(n, analysis.intakes[0].work) is not None][:4]
    if not shown:
        return None
    rows = (len(shown) + 1) // 2
    figure, axes = _figure(rows, 2.7, min(2, len(shown)))
    for axis in axes.ravel()[len(shown) :]:
        axis.set_visible(False)
    for axis, name in zip(axes.ravel(), shown, strict=False):
        _driver_plot(axis, analysis, name)
        for regime in [r for f in diagnosis.findings[:1] for r in f.where.regimes if r.driver == name]:
            axis.axvspan(regime.low, regime.high, color=MARK, alpha=0.45, lw=0)
    return data_uri(figure)


def _driver_plot(axis: Any, analysis: Analysis, name: str) -> None:
    times_rate = name.startswith("rate_times")
    for which, colour, label in ((0, BEFORE, "before"), (1, AFTER, "after")):
        values, errors, weights = [], [], []
        for index, intake in enumerate(analysis.intakes):
            driver = driver_values(name, intake.work)
            if driver is None:
                continue
            w = intake.work.w if times_rate else np.ones(len(driver))
            values.append(driver)
            errors.append(_curves(analysis, index)[which] * w)
            weights.append(w * w)
        centre, mean = _binned(np.concatenate(values), np.concatenate(errors), np.concatenate(weights))
        axis.plot(centre, 1e6 * mean if times_rate else mean, ".-", color=colour, ms=4, lw=0.8, label=label)
    axis.set_xlabel(driver_label(name))
    axis.set_ylabel("scale error [ppm]" if times_rate else "error [°/s]")
    axis.grid(True, alpha=0.2)
    axis.legend(fontsize=8)


def _binned(
    values: FloatArray, errors: FloatArray, weights: FloatArray, bins: int = 30
) -> tuple[FloatArray, FloatArray]:
    edges = np.linspace(values.min(), values.max(), bins + 1)
    place = np.clip(np.digitize(values, edges) - 1, 0, bins - 1)
    total = np.bincount(place, weights=weights, minlength=bins)
    keep = total > 0.0
    mean = np.bincount(place, weights=errors, minlength=bins)[keep] / total[keep]
    return (0.5 * (edges[1:] + edges[:-1]))[keep], mean


def allan_plot(analysis: Analysis) -> str | None:
    """Overlapping Allan deviation of the error before and after."""
    if analysis.intakes[0].work.points:
        return None
    import allantools

    figure, axes = _figure(1, 3.2)
    axis, work = axes[0][0], analysis.intakes[0].work
    for values, colour, label in zip(_curves(analysis, 0), (BEFORE, AFTER), ("before", "after"), strict=True):
        taus, deviation, _, _ = allantools.oadev(
            values, rate=1.0 / work.step_s, data_type="freq", taus="octave"
        )
        axis.loglog(taus, 3600.0 * deviation, "o-", color=colour, ms=3, lw=0.9, label=label)
    axis.set_title(f"{analysis.intakes[0].recording.name}: Allan deviation of the error", fontsize=9)
    axis.set_xlabel("averaging time [s]")
    axis.set_ylabel("Allan deviation [°/h]")
    axis.grid(True, which="both", alpha=0.2)
    axis.legend(fontsize=8)
    return data_uri(figure)


def heldout_plot(analysis: Analysis) -> str | None:
    """Block means of the misfit in up to three recordings of the proof, before and after, over their own time."""
    proofs = analysis.proofs[:3]
    if not proofs:
        return None
    figure, axes = _figure(len(proofs), 2.0)
    intakes = analysis.heldout or analysis.intakes
    for axis, proof, intake in zip(axes[:, 0], proofs, intakes, strict=False):
        t = np.linspace(intake.work.t[0], intake.work.t[-1], len(proof.slow_before))
        for values, colour, label in (
            (proof.slow_before, BEFORE, "before"),
            (proof.slow_after, AFTER, "after"),
        ):
            axis.plot(t, _thin(values), color=colour, lw=0.8, label=label)
        axis.set_title(f"{proof.name}: misfit that had no part in the fit", fontsize=9)
        axis.set_xlabel("point" if intake.work.points else "t [s]")
        axis.set_ylabel("°/s")
        axis.grid(True, alpha=0.2)
        axis.legend(loc="upper right", fontsize=8)
    return data_uri(figure)


def _thin(values: FloatArray, width: int = 15) -> FloatArray:
    """Moving mean for display."""
    return smooth(values, 1.0, width) if len(values) > 10 * width else values


def regime_text(findings: Sequence[Finding]) -> list[str]:
    """The regimes of every finding in words."""
    return [
        " and ".join(
            f"{driver_word(r.driver)} {r.low:.3g} … {r.high:.3g} {driver_unit(r.driver)}"
            for r in f.where.regimes[:4]
        )
        for f in findings
    ]
