"""Truths sealed before the tool runs: written with their sha256, and refused at scoring when they do not match."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from rtcomp.errors import WorkError
from tools.blind.cases import Case, Made
from training.table import Recording, write_recording

SEALS = "seals.json"


def canonical(document: Any) -> bytes:
    """One byte string for a JSON document, whatever the order of its keys."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def write_case(case: Case, folder: Path) -> str:
    """Write recordings to FOLDER/seen and the truth to FOLDER/sealed; return the seal, a sha256 over all the truth.

    The waveforms are hashed as arrays, not as a compressed file, so that the seal depends on the truth alone.
    """
    (folder / "seen").mkdir(parents=True, exist_ok=True)
    (folder / "sealed").mkdir(exist_ok=True)
    arrays: dict[str, np.ndarray] = {}
    for made in (*case.training, *case.heldout):
        write_recording(Recording(made.name, made.columns), folder / "seen" / f"{made.name}.parquet")
        arrays |= _named(made)
    (folder / "seen" / "arguments.json").write_bytes(canonical(case.arguments))
    np.savez_compressed(folder / "sealed" / "waves.npz", allow_pickle=False, **arrays)
    (folder / "sealed" / "truth.json").write_bytes(canonical(case.truth))
    return _digest(canonical(case.truth), arrays)


def _named(made: Made) -> dict[str, np.ndarray]:
    return {f"{made.name}/{key}": wave for key, wave in made.waves.items()}


def _digest(truth: bytes, arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(truth)
    for name in sorted(arrays):
        digest.update(name.encode() + b"\0" + np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def open_case(folder: Path, seal: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The truth and its waveforms {"recording/effect": shape (n,)}; WorkError when they are not what was sealed."""
    truth = (folder / "sealed" / "truth.json").read_bytes()
    with np.load(folder / "sealed" / "waves.npz") as file:
        arrays = {name: file[name] for name in file.files}
    found = _digest(truth, arrays)
    if found != seal:
        raise WorkError(
            f"{folder}: the truth has sha256 {found[:12]}…, sealed was {seal[:12]}…; "
            "make the cases again and never edit them"
        )
    return json.loads(truth), arrays


def write_seals(seals: dict[str, str], header: dict[str, Any], root: Path) -> str:
    """Write all seals before the tool runs; return the sha256 of that file's contents."""
    document = canonical(header | {"cases": seals})
    (root / SEALS).write_bytes(document)
    return hashlib.sha256(document).hexdigest()


def read_seals(root: Path) -> dict[str, Any] | None:
    """The seals of an earlier run in this folder, or None."""
    path = root / SEALS
    return json.loads(path.read_bytes()) if path.is_file() else None
