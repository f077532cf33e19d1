"""How much of a held-out recording's misfit a predicted effect removes, against an oracle that knows the truth."""

from typing import Any

import numpy as np
import pyarrow.csv

from tools.blind.noise import Noise, NoiseModel, SoakNoise, basis
from training.table import Recording


def noise_of(sealed: dict[str, Any], omega_dps: np.ndarray) -> Noise:
    """The sealed noise model of one recording."""
    if "soak" in sealed:
        return SoakNoise(sealed["white_dps"], sealed["soak_ppm"], omega_dps, np.array(sealed["soak"]))
    relaxations = tuple((float(v), float(t), bool(k)) for v, t, k in sealed["relaxations"])
    return NoiseModel(sealed["dt_s"], sealed["white_dps"], sealed["walk_dps_per_rs"], relaxations)


def read_correction(path, times_s: np.ndarray | None, rows: int) -> np.ndarray | None:
    """The tool's `correction_dps` at our rows, shape (rows,), or None where the file does not fit them."""
    table = pyarrow.csv.read_csv(path)
    if "correction_dps" not in table.column_names:
        return None
    values = np.asarray(table["correction_dps"].to_numpy(), float)
    if len(values) == rows:
        return values
    if times_s is None or "t_s" not in table.column_names or len(values) < 2:
        return None
    return np.interp(times_s, np.asarray(table["t_s"].to_numpy(), float), values)


def compare(
    residual: np.ndarray, correction: np.ndarray, truth: np.ndarray, omega: np.ndarray, noise: Noise
) -> dict[str, Any]:
    """Misfit before, after the tool's correction and after the oracle's, offset and scale removed from each.

    All arrays have shape (n,) and are in °/s; `misfit_ratio` is 1 for the oracle and 0 for doing nothing,
    `rms_ratio` is the tool's RMS over the oracle's.
    """
    nuisance = np.column_stack([c for c in (np.ones_like(omega), omega) if np.any(c)])
    tries = {"before": residual, "after": residual - correction, "oracle": residual - truth}
    flat, white = basis(nuisance), basis(noise.whiten(nuisance))
    chi2, rms = {}, {}
    for name, values in tries.items():
        whitened = noise.whiten(values)
        chi2[name] = float(np.sum((whitened - white @ (white.T @ whitened)) ** 2))
        rms[name] = float(np.sqrt(np.mean((values - flat @ (flat.T @ values)) ** 2)))
    gain = chi2["before"] - chi2["oracle"]
    return {
        "misfit_ratio": (chi2["before"] - chi2["after"]) / gain if gain > 0 else None,
        "oracle_gain": gain,
        "rms_ratio": rms["after"] / rms["oracle"],
        "rms_before_dps": rms["before"],
        "rms_after_dps": rms["after"],
        "rms_oracle_dps": rms["oracle"],
    }


def lasting(truth: dict[str, Any]) -> list[dict[str, Any]]:
    """The planted effects that a held-out recording has too, and that a correction can remove."""
    return [e for e in truth["effects"] if e["transferable"] and not e["frames"] and not e["variance"]]


def against_oracle(
    recording: Recording,
    name: str,
    correction: np.ndarray,
    truth: dict[str, Any],
    arrays: dict[str, np.ndarray],
) -> dict[str, Any]:
    """Compare a correction, shape (n,), with the sealed waveforms of the held-out recording `name`.

    The true rate stands in the reference's place: predicting the reference's noise must earn nobody anything.
    """
    omega = arrays[f"{name}/omega_dps"].astype(float)
    waves = {e["effect"]: arrays[f"{name}/{e['effect']}"].astype(float) for e in lasting(truth)}
    simulated = recording.get("sim_rate_dps")
    residual = recording["rate_dps"] - (omega if simulated is None else simulated)
    for effect in lasting(truth):
        if effect["in_reference"]:
            residual = residual + waves[effect["effect"]]
    noise = noise_of(truth["recordings"][name]["noise"], omega)
    return compare(residual, correction, np.sum(list(waves.values()), axis=0), omega, noise)


def active_segments(wave: np.ndarray, t_s: np.ndarray, window_s: float = 60.0) -> list[tuple[float, float]]:
    """Where a waveform, shape (n,), is at work: windows in which its RMS exceeds 30 % of its largest."""
    edges = np.arange(t_s[0], t_s[-1] + window_s, window_s)
    centred = wave - np.median(wave)
    which = np.clip(np.searchsorted(edges, t_s, side="right") - 1, 0, len(edges) - 2)
    power = np.bincount(which, centred**2, len(edges) - 1) / np.maximum(
        np.bincount(which, minlength=len(edges) - 1), 1
    )
    busy = np.sqrt(power) > 0.3 * np.sqrt(power.max())
    starts = np.flatnonzero(np.diff(np.concatenate([[0], busy.astype(int), [0]])))
    return [(float(edges[a]), float(edges[b])) for a, b in zip(starts[::2], starts[1::2], strict=True)]


def overlap(first: list[tuple[float, float]], second: list[tuple[float, float]]) -> float:
    """Intersection over union of two lists of time segments [s], on a 1 s grid."""
    ends = [end for _, end in (*first, *second)]
    if not ends:
        return 0.0
    grid = np.arange(0, max(ends), 1.0) + 0.5
    inside = [
        np.any([(grid >= a) & (grid < b) for a, b in part] or [np.zeros(len(grid), bool)], axis=0)
        for part in (first, second)
    ]
    union = np.count_nonzero(inside[0] | inside[1])
    return float(np.count_nonzero(inside[0] & inside[1]) / union) if union else 0.0
