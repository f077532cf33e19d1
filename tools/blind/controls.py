"""Four controls: another recording's temperature, time run backwards, injection into a real recording, ablation."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tools.blind.catalogue import THERMAL_DRIVERS
from tools.blind.materials import fringes
from tools.blind.relays import preisach
from tools.blind.runner import Outcome, command_options
from tools.blind.score import score_heldout, stranger
from tools.blind.sealing import canonical, open_case
from tools.blind.summary import ALIKE, PROVED, rate
from tools.blind.thermal import conduct, mohr
from tools.blind.trial import Told, run_tool
from training.table import Recording, read_recording, write_recording

Document = dict[str, Any]
Opened = tuple[Document, dict[str, np.ndarray]]  # what a seal kept: the truth and its waveforms
SWITCH = "--without"
STATIC = (
    "scale_temperature",
    "scale_nonlinearity",
    "scale_asymmetry",
    "bias_temperature",
    "polarization_ripple",
)
DYNAMIC = (
    "thermal_lag",
    "shupe",
    "bias_hysteresis",
    "scale_hysteresis",
    "scale_temperature_rate",
    "bias_warmup",
)
AMPLITUDES = (
    "scale_ppm_per_K",
    "c1_dps_s_per_K",
    "c_dps_per_K",
    "c_ppm_per_K",
    "c_ppm_s_per_K",
    "amplitude_dps",
)
REAL = "tofupilot_mems_chamber.csv.gz"
REAL_UNIT_DPS = {"polarization_ripple": 0.08, "bias_hysteresis": 0.3, "bias_step": 0.15, "shupe": 0.15}
"""Peak of what is injected: several times the white noise of 9 to 21 m°/s, well under the drift of that sensor."""


def recordings_folder() -> Path:
    """Where real recordings are: $RTCOMP_RECORDINGS, else ../shared/recordings beside the project."""
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "recordings"
    return Path(os.environ.get("RTCOMP_RECORDINGS", beside))


def run_controls(
    root: Path, scores: list[Document], seals: dict[str, str], count: int, jobs: int, seed: int, told: Told
) -> Document:
    """Run `count` cases of each control and count what came of them."""
    base = root / "controls"
    rng = np.random.default_rng([seed, 9])
    shuffled = _prepare_shuffle(root, base, scores, count, rng)
    reversed_ = _prepare_reversal(root, base, scores, count)
    ablated = _prepare_ablation(root, base, scores, count) if SWITCH in command_options() else {}
    injected = _prepare_injection(base, count, rng)
    names = [*shuffled, *reversed_, *ablated, *injected]
    outcomes = run_tool(base, names, jobs, told) if names else {}
    opened = {name: open_case(root / name, seals[name]) for name in ablated.values()}
    return {
        "label_shuffle": _judge_shuffle(shuffled, outcomes),
        "time_reversal": _judge_reversal(reversed_, outcomes, {s["case"]: s for s in scores}, root),
        "injection_into_real": _judge_injection(injected, outcomes),
        "ablation": _judge_ablation(ablated, outcomes, base, opened)
        if ablated
        else {"note": f"no {SWITCH} switch, or no case fit for it"},
    }


def _copy(source: Path, target: Path, change, arguments: list[str]) -> None:
    """A variant of a case: every recording passed through `change(columns)`."""
    seen = target / "seen"
    if (target / "outcome.json").is_file():
        return
    shutil.rmtree(target, ignore_errors=True)
    seen.mkdir(parents=True)
    given = json.loads((source / "seen" / "arguments.json").read_bytes())
    for path in sorted((source / "seen").glob("*.parquet")):
        recording = read_recording(path)
        write_recording(Recording(recording.name, change(dict(recording.columns))), seen / path.name)
    (seen / "arguments.json").write_bytes(canonical([*given, *arguments]))


def _fit(scores: list[Document], effects: tuple[str, ...] | None, strong: float = 20.0) -> list[Document]:
    return [
        s
        for s in scores
        if len(s["effects"]) == 1
        and len(s["truth"]) == 1
        and s["level"] in ("L1", "L2")
        and s["effects"][0]["dprime"] >= strong
        and s["effects"][0]["in_class"]
        and not s["effects"][0]["frames"]
        and (effects is None or s["truth"][0] in effects)
    ]


def _prepare_shuffle(
    root: Path, base: Path, scores: list[Document], count: int, rng: np.random.Generator
) -> dict[str, str]:
    """Null recordings whose temperature is that of another recording, stretched to fit; {variant: case}."""
    nulls = [
        s
        for s in scores
        if s["level"] == "L0" and s["kind"] in ("zero/cycle", "table/cycle", "drive/cold_start")
    ]
    donors = [s["case"] for s in scores if s["kind"].endswith(("cycle", "cold_start"))]
    made = {}
    for s in nulls[:count]:
        donor = str(rng.choice([d for d in donors if d != s["case"]] or donors))
        foreign = read_recording(root / donor / "seen" / "recording-1.parquet")["temp_degC"]

        def exchange(columns, foreign=foreign):
            place = np.linspace(0, len(foreign) - 1, len(columns["temp_degC"]))
            return columns | {"temp_degC": foreign[np.round(place).astype(int)]}

        _copy(root / s["case"], base / f"shuffle-{s['case']}", exchange, [])
        made[f"shuffle-{s['case']}"] = s["case"]
    return made


def _judge_shuffle(made: dict[str, str], outcomes: dict[str, Outcome]) -> Document:
    found = [outcomes[name].document for name in made]
    thermal = [bool(d) and any(f.get("driver") in THERMAL_DRIVERS for f in d["findings"]) for d in found]
    return {
        "thermal_finding": rate(thermal, "0"),
        "any_finding": rate([bool(d and d["findings"]) for d in found], "0"),
    }


def _backwards(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    turned = {name: values[::-1].copy() for name, values in columns.items()}
    if "t_s" in columns:
        turned["t_s"] = columns["t_s"][-1] - turned["t_s"]
    if "counter" in columns:
        turned["counter"] = columns["counter"]
    return turned


def _prepare_reversal(root: Path, base: Path, scores: list[Document], count: int) -> dict[str, str]:
    """Static and dynamic effects that were found, with time run backwards; {variant: case}."""
    chosen = _fit(scores, STATIC)[:count] + _fit(scores, DYNAMIC)[:count]
    for s in chosen:
        _copy(root / s["case"], base / f"reversed-{s['case']}", _backwards, ["--power-on", "unknown"])
    return {f"reversed-{s['case']}": s["case"] for s in chosen}


def _amplitude_sign(document: Document | None, name: str) -> float | None:
    for finding in (document or {"findings": []})["findings"]:
        if finding["effect"] == name:
            values = [finding["parameters"][a]["value"] for a in AMPLITUDES if a in finding["parameters"]]
            return float(np.sign(values[0])) if values else None
    return None


def _judge_reversal(
    made: dict[str, str], outcomes: dict[str, Outcome], scores: dict[str, Document], root: Path
) -> Document:
    """Static effects keep their name; dynamic ones lose it, or their sign turns."""
    kept, changed = [], []
    for variant, case in made.items():
        name, document = scores[case]["truth"][0], outcomes[variant].document
        there = bool(document) and any(name in f["alternatives"] for f in document["findings"])
        if name in STATIC:
            kept.append(there)
            continue
        before = json.loads((root / case / "found" / "diagnosis.json").read_bytes())
        signs = _amplitude_sign(before, name), _amplitude_sign(document, name)
        alone = bool(document) and any(f["effect"] == name for f in document["findings"])
        changed.append(not alone or None in signs or signs[0] != signs[1])
    return {"static_kept": rate(kept, "1"), "dynamic_changed": rate(changed, "1")}


def _prepare_ablation(root: Path, base: Path, scores: list[Document], count: int) -> dict[str, str]:
    """Found, separable effects, with their entry taken out of the catalogue; {variant: case}."""
    chosen = [s for s in _fit(scores, None, 30.0) if len(s["effects"][0]["inseparable"]) == 1][:count]
    for s in chosen:
        _copy(root / s["case"], base / f"ablated-{s['case']}", dict, [SWITCH, s["truth"][0]])
    return {f"ablated-{s['case']}": s["case"] for s in chosen}


def _judge_ablation(
    made: dict[str, str], outcomes: dict[str, Outcome], base: Path, opened: dict[str, Opened]
) -> Document:
    """Scored as an effect that never was in the catalogue.

    Apart: where a neighbour of the effect reproduces so much of it on the held-out recording that it passes for it.
    """
    entries = []
    for variant, case in made.items():
        truth, waves = opened[case]
        document = outcomes[variant].document
        findings = document["findings"] if document else []
        proofs = score_heldout(base / variant, truth, waves) if document else []
        passed = min(
            (p["misfit_ratio"] for p in proofs if p["fits"] and p["oracle_gain"] > PROVED), default=0.0
        )
        told = stranger(truth["effects"][0], findings, document) | {"case": case, "misfit_ratio": passed}
        entries.append(told | {"another": any(f["status"] == "named" for f in findings)})
    unlike = [e for e in entries if e["misfit_ratio"] < ALIKE or e["flagged"]]
    return {
        "unknown": rate([e["flagged"] for e in unlike], "1"),
        "driver_right": rate([e["driver_right"] for e in unlike if e["flagged"]], "1"),
        "another_name_alone": rate([e["another"] and not e["flagged"] for e in unlike], "0"),
        "partly_explained_where_another_passes": rate(
            [e["partly"] for e in entries if e not in unlike], ">= 0.70"
        ),
        "cases": entries,
    }


def _injections(temp: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Waveforms for the real recording, each with its unit peak, shape (n,)."""
    step_s = 2.0
    grid = np.arange(0, t[-1] + step_s, step_s)
    face = np.interp(grid, t, np.convolve(np.pad(temp, 20, mode="edge"), np.full(41, 1 / 41), mode="valid"))
    coil = conduct(face, step_s, 0.008, 1.5e-7, 0.2)
    raw = {
        "polarization_ripple": fringes(
            temp, np.array([0.2, 3 / rng.uniform(7, 12), 0.1]), 0.0, rng.uniform(0, 6, 4)
        ),
        "bias_hysteresis": np.interp(
            t, grid, preisach(face, rng.uniform(4, 8), 0.2, int(rng.integers(1 << 30)))
        ),
        "bias_step": (t > rng.uniform(0.35, 0.65) * t[-1]).astype(float),
        "shupe": np.interp(t, grid, mohr(coil, face, 0.5, 1.0, 0.1)),
    }
    return {name: REAL_UNIT_DPS[name] * wave / np.abs(wave).max() for name, wave in raw.items()}


def _prepare_injection(base: Path, count: int, rng: np.random.Generator) -> dict[str, tuple[str, str]]:
    """Each axis of the real chamber recording as it is, and with a known waveform; {variant: (axis, effect or "")}."""
    path = recordings_folder() / REAL
    if not path.is_file():
        return {}
    made: dict[str, tuple[str, str]] = {}
    for axis in "xyz"[: max(1, min(3, count))]:
        real = read_recording(path, {"rate_dps": f"gyro_{axis}_dps", "temp_degC": "temp_C"}).take(
            np.arange(8400) > 0
        )
        columns = {name: real[name] for name in ("t_s", "rate_dps", "temp_degC")}
        waves = {"": np.zeros(len(real))} | _injections(columns["temp_degC"], columns["t_s"], rng)
        for effect, wave in list(waves.items())[: 1 + count]:
            name = f"real-{axis}-{effect or 'as_it_is'}"
            _write_real(base / name, columns | {"rate_dps": columns["rate_dps"] + wave})
            made[name] = (axis, effect)
    return made


def _write_real(folder: Path, columns: dict[str, np.ndarray]) -> None:
    seen = folder / "seen"
    seen.mkdir(parents=True, exist_ok=True)
    write_recording(Recording("recording-1", columns), seen / "recording-1.parquet")
    (seen / "arguments.json").write_bytes(canonical(["--static", "--power-on", "unknown"]))


def _judge_injection(made: dict[str, tuple[str, str]], outcomes: dict[str, Outcome]) -> Document:
    """Recovered: in a class now, and not in one of the untouched recording (those axes are left out)."""
    if not made:
        return {"note": f"skipped: no {REAL} in {recordings_folder()}"}
    classes = {
        made[name]: {
            a for f in (outcomes[name].document or {"findings": []})["findings"] for a in f["alternatives"]
        }
        for name in made
    }
    plain = {axis: sorted(found) for (axis, effect), found in classes.items() if not effect}
    fresh = [(key, found) for key, found in classes.items() if key[1] and key[1] not in plain[key[0]]]
    return {
        "recovered": rate([effect in found for (_, effect), found in fresh]),
        "real_axes_as_they_are": plain,
        "found": {f"{axis} + {effect}": sorted(found) for (axis, effect), found in classes.items() if effect},
    }
