"""Scores one diagnosis against its sealed truth; knows nothing of how either was made."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tools.blind.catalogue import THERMAL_DRIVERS
from tools.blind.proof import active_segments, against_oracle, lasting, overlap, read_correction
from training.table import read_recording

Document = dict[str, Any]
NAMES = {
    "delay_s": ("delay_s", "skew_s", "tau_s"),
    "clock_ppm": ("clock_ppm", "drift_ppm", "ppm"),
    "cutoff_hz": ("cutoff_hz", "bandwidth_hz", "f_c_hz", "fc_hz", "corner_hz"),
    "lsb_dps": ("lsb_dps", "step_dps", "resolution_dps"),
    "step_dps": ("step_dps", "amplitude_dps", "size_dps", "c_dps"),
    "step_ppm": ("step_ppm", "amplitude_ppm", "size_ppm", "c_ppm"),
    "time_s": ("t0_s", "time_s", "at_s", "t_s"),
    "lock_dps": ("lock_dps", "width_dps", "half_width_dps"),
    "limit_dps": ("limit_dps", "knee_dps"),
    "c1_dps_per_g": ("c1_dps_per_g", "c_dps_per_g", "g1_dps_per_g"),
    "sigma_s": ("sigma_s", "jitter_s"),
    "dps": ("dps", "offset_dps", "bias_dps"),
    "ppm": ("ppm", "scale_ppm"),
}
"""Names under which a parameter may be reported where no contract fixes one."""
FIRST_CLASS = 3


def score(truth: Document, found: Document | None, status: str) -> Document:
    """Everything that the document alone can be held against. `found` is None when the tool gave none."""
    effects = [e for e in truth["effects"] if not e["unlisted"]]
    findings = found["findings"] if found else []
    named = [f for f in findings if f["status"] != "unknown"]
    said = {
        "case": truth["case"],
        "level": truth["level"],
        "kind": truth["kind"],
        "status": status,
        "truth": [e["effect"] for e in truth["effects"]],
        "verdict": found["verdict"] if found else status,
        "findings": [[f["effect"], f["status"], f["alternatives"], f.get("driver")] for f in findings],
        "effects": [_effect(e, findings, found) for e in effects],
        "integrity_said": sorted(_integrity(found)),
    }
    expected = {e["effect"] for e in effects}
    known_names = expected | {twin for e in effects for twin in e["inseparable"]}
    extra = [f for f in named if not known_names & set(f["alternatives"])]
    said["extra_names"] = len(extra)
    said["extra_unknown"] = 0 if _unlisted(truth) else len(findings) - len(named)
    said["confident_wrong"] = any(
        f["status"] == "named" and not expected & set(f["alternatives"]) for f in findings
    )
    said["false_alarm"] = bool(findings) or said["verdict"] in (
        "named",
        "ambiguous",
        "unknown",
        "bad_recording",
    )
    said["remainder"] = bool(found and found.get("remainder"))
    said["unlisted"] = [stranger(e, findings, found) for e in _unlisted(truth)]
    said["thermal_names"] = sum(f.get("driver") in THERMAL_DRIVERS for f in findings)
    said["visible_from"] = dict(found.get("visible_from") or {}) if found else {}
    said["silent"] = [_silent(e, findings) for e in effects if len(e["inseparable"]) > 1]
    return said


def _unlisted(truth: Document) -> list[Document]:
    return [e for e in truth["effects"] if e["unlisted"]]


def _integrity(found: Document | None) -> set[str]:
    """Ids of integrity faults that the document mentions anywhere among its recordings."""
    if not found:
        return set()
    words = json.dumps([r.get("integrity", []) for r in found.get("recordings", [])])
    return {
        name for name in ("frozen_frames", "dropped_frames", "counter_wrap", "unit_error") if name in words
    }


def _effect(effect: Document, findings: list[Document], found: Document | None) -> Document:
    """One planted effect: whether it is in a reported class, alone, first, and what its driver was said to be."""
    name = effect["effect"]
    holding = [f for f in findings if name in f["alternatives"]]
    mentioned = effect["frames"] and name in _integrity(found)
    drivers = [d["driver"] for d in (found or {}).get("drivers", [])][:2]
    return {
        "effect": name,
        "dprime": effect["dprime"],
        "rms_dps": effect["rms_dps"],
        "frames": effect["frames"],
        "in_class": bool(holding) or mentioned,
        "in_class_of_3": any(len(f["alternatives"]) <= FIRST_CLASS for f in holding) or mentioned,
        "class_size": len(holding[0]["alternatives"]) if holding else None,
        "first": bool(findings) and findings[0]["effect"] == name,
        "any_first": any(f["effect"] == name for f in findings) or mentioned,
        "named_alone": any(f["status"] == "named" and f["effect"] == name for f in findings),
        "driver_located": bool(set(drivers) & set(effect["drivers"])),
        "inseparable": effect["inseparable"],
        "parameters": _parameters(effect, holding[0]["parameters"]) if holding else [],
    }


def _silent(effect: Document, findings: list[Document]) -> Document:
    """Whether one of several inseparable names was stated alone; right or wrong makes no difference."""
    twins = set(effect["inseparable"])
    alone = [f for f in findings if f["status"] == "named" and f["effect"] in twins]
    whole = any(twins & set(f["alternatives"]) and effect["effect"] in f["alternatives"] for f in findings)
    advised = all(f.get("separate_by") for f in findings if f["status"] == "ambiguous")
    return {"effect": effect["effect"], "silent": bool(alone), "in_class": whole, "advised": advised}


def stranger(effect: Document, findings: list[Document], found: Document | None) -> Document:
    """What was said of an effect that is not in the catalogue: flagged, partly explained, its driver."""
    flagged = [f for f in findings if f["status"] == "unknown"]
    partly = bool(flagged) or bool(found and found.get("remainder"))
    return {
        "effect": effect["effect"],
        "dprime": effect["dprime"],
        "catalogue_r2": effect["catalogue_r2"],
        "flagged": bool(flagged),
        "driver_right": any(f.get("driver") in effect["drivers"] for f in flagged),
        "partly": partly,
        "silent": not findings,
    }


def _parameters(effect: Document, reported: Document) -> list[Document]:
    """Truth beside estimate for every parameter that both know."""
    rows = []
    for name, known in effect["known"].items():
        entry = next((reported[n] for n in NAMES.get(name, (name,)) if n in reported), None)
        if entry is None or entry.get("value") is None:
            continue
        value = abs(entry["value"]) if known["magnitude"] else entry["value"]
        low, high = entry.get("ci95") or (None, None)
        bounded = low is not None and high is not None and not known["magnitude"]
        rows.append(
            {
                "name": name,
                "truth": known["value"],
                "value": value,
                "error": abs(value - known["value"]) / abs(known["value"]) if known["value"] else None,
                "covered": bool(low <= known["value"] <= high) if bounded and known["exact"] else None,
            }
        )
    return rows


def score_heldout(
    folder: Path, truth: Document, arrays: dict[str, np.ndarray], out: str = "found"
) -> list[Document]:
    """The held-out corrections that the tool wrote, against the oracle, one entry per held-out recording."""
    rows = []
    for name in sorted(n for n in truth["recordings"] if n.startswith("heldout")):
        recording = read_recording(folder / "seen" / f"{name}.parquet")
        path = folder / out / "heldout" / f"{name}.csv"
        if (
            not path.is_file()
            or not lasting(truth)
            or any(e["effect"] == "unit_error" for e in truth["effects"])
        ):
            continue
        correction = read_correction(path, recording.get("t_s"), len(recording))
        if correction is None:
            rows.append({"recording": name, "fits": False})
            continue
        told = against_oracle(recording, name, correction, truth, arrays)
        rows.append({"recording": name, "fits": True} | told)
    return rows


def score_where(
    folder: Path, truth: Document, arrays: dict[str, np.ndarray], found: Document | None
) -> float | None:
    """Overlap of reported and true active segments of the first planted effect, for partly excited cases (L4)."""
    if truth["level"] != "L4" or not found:
        return None
    name = truth["effects"][0]["effect"]
    holding = [f for f in found["findings"] if name in f["alternatives"]] or found["findings"]
    if not holding:
        return 0.0
    t = read_recording(folder / "seen" / "recording-1.parquet")["t_s"]
    segments = (holding[0].get("where") or {}).get("segments") or []
    if segments and segments[0] and isinstance(segments[0][0], (list, tuple)):
        segments = segments[0]
    said = [(float(a), float(b)) for a, b in segments]
    return overlap(said, active_segments(arrays[f"recording-1/{name}"].astype(float), t))
