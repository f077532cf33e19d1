"""The fitted noise in a gyro's own terms, and its comparison with a simulation that carries a noise model."""

from typing import Any

import numpy as np

from training.diagnose.document import Finding, Parameter, Where
from training.diagnose.pipeline import Analysis
from training.diagnose.spectrum import SHAPES, band_frequencies, shapes
from training.diagnose.work import FloatArray, Work
from training.effects.catalogue import effect

HOW = (
    "Whittle likelihood of the residual's DCT coefficients under a non-negative sum of white, 1/f, 1/f², f² and "
    "Lorentzian spectra, refitted in every comparison, so that an effect has to beat 'more slow noise'; family-wise "
    "p-values from parametric surrogates of this noise, run through the same search"
)
RATIO = 1.5


def gyro_terms(weights: FloatArray, work: Work) -> dict[str, float]:
    """Angle random walk [deg/√h], bias instability [deg/h] and rate random walk [deg/h/√h] of fitted weights."""
    if work.points:
        return {
            "white_dps": float(np.sqrt(weights[0])),
            "soak_scale_dps": float(np.sqrt(weights[1])),
            "soak_bias_dps": float(np.sqrt(weights[2])),
        }
    edges = work.bands()
    u = band_frequencies(edges, len(work))
    scale = {
        name: float((phi / shape).max())
        for name, phi, shape in zip(
            SHAPES[:3], shapes(u, len(work))[:3], (np.ones_like(u), 1.0 / u, 1.0 / u**2), strict=True
        )
    }
    white, flicker, walk = (weights[i] * scale[name] for i, name in enumerate(SHAPES[:3]))
    return {
        "arw_deg_rt_h": float(60.0 * np.sqrt(white * work.step_s)),
        "bias_instability_deg_h": float(3600.0 * np.sqrt(flicker)),
        "rrw_deg_h_rt_h": float(216_000.0 * np.sqrt(walk / work.step_s)),
    }


def noise_note(analysis: Analysis) -> dict[str, Any]:
    """What is printed under `noise`."""
    fitted = analysis.model or analysis.base
    note: dict[str, Any] = {"how": HOW, "seed": analysis.settings.seed}
    if analysis.null is not None:
        note |= {"surrogates": analysis.null.count, "threshold": analysis.null.excess_at(1e-3)}
    if fitted is not None:
        note["recordings"] = [
            {"file": i.recording.name, "step_s": i.work.step_s} | gyro_terms(w, i.work)
            for i, w in zip(analysis.intakes, fitted.fit.weights, strict=True)
        ]
    return note


def noise_findings(analysis: Analysis) -> list[Finding]:
    """`noise_level`, where the simulation carries a noise model and the recording's differs by half or more."""
    model = analysis.model
    if analysis.simulation.noise is None or model is None or analysis.intakes[0].work.points:
        return []
    if "noise_level" in analysis.settings.left_out:
        return []
    worst, cuts = None, np.cumsum([len(d.edges) - 1 for d in analysis.domains])[:-1]
    for d, spectrum in zip(analysis.domains, np.split(model.fit.spectrum, cuts), strict=True):
        expected = _expected(dict(analysis.simulation.noise), d.work)
        counts = np.diff(d.edges)
        rich = counts >= 8
        log_ratio = np.log(spectrum[rich] / expected[rich])
        level = float(np.sum(counts[rich] * log_ratio) / np.sum(counts[rich]))
        if worst is None or abs(level) > abs(worst[0]):
            worst = (level, float(np.sum(counts[rich])), float(np.sqrt(np.mean(spectrum))))
    if worst is None or abs(worst[0]) < 2.0 * np.log(RATIO):
        return []
    ratio = float(np.exp(0.5 * worst[0]))
    half = ratio * 1.96 * float(np.sqrt(0.5 / worst[1]))
    return [
        Finding(
            effect="noise_level",
            status="named",
            alternatives=["noise_level"],
            separate_by=None,
            driver="time",
            where=Where([[] for _ in analysis.intakes], []),
            parameters={"ratio": Parameter(ratio, "1", (ratio - half, ratio + half))},
            rms_dps=worst[2],
            p_value=1e-12,
            text=f"{effect('noise_level').title}: the recording is {ratio:.2g} times as noisy as the simulation",
            strength=0.0,
        )
    ]


def _expected(noise: dict[str, float], work: Work) -> FloatArray:
    u = band_frequencies(work.bands(), len(work))
    n = noise.get("arw_deg_rt_h", 0.0) / 60.0
    b = noise.get("bias_instability_deg_h", 0.0) / 3600.0
    r = noise.get("rrw_deg_h_rt_h", 0.0) / 216_000.0
    return n * n / work.step_s + b * b / u + r * r * work.step_s / u**2 + 1e-300
