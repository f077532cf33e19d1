"""heldout/NAME.csv: what the found physics predicts on every row of a held-out recording, for anyone to check."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtcomp.atomic import write_atomically
from rtcomp.compensator import predict
from rtcomp.model import new_model
from training.diagnose.document import Diagnosis
from training.diagnose.extended import coefficient_terms
from training.diagnose.intake import Intake
from training.diagnose.pipeline import Analysis
from training.diagnose.work import FloatArray
from training.table import Recording


def write_heldout(
    analysis: Analysis, diagnosis: Diagnosis, recordings: Sequence[Recording], folder: Path
) -> None:
    """Write one table per held-out recording, rows as the recording has them; zeros where nothing is predicted."""
    if not recordings:
        return
    folder.mkdir(exist_ok=True)
    proofs = {id(i.recording): (i, p) for i, p in zip(analysis.heldout, analysis.proofs, strict=False)}
    for recording in recordings:
        correction = np.zeros(len(recording))
        if id(recording) in proofs:
            intake, proof = proofs[id(recording)]
            correction = on_rows(proof.prediction, intake, len(recording)) + _coefficients(diagnosis, intake)
        write_atomically(folder / f"{recording.name}.csv", _table(_times(recording), correction))


def on_rows(values: FloatArray, intake: Intake, rows: int) -> FloatArray:
    """Values of the checked rows on the recording's own rows: sorted back, left-out rows bridged."""
    kept = intake.checked.rows
    order = np.argsort(kept, kind="stable")
    return np.interp(np.arange(rows), kept[order], values[order])


def _coefficients(diagnosis: Diagnosis, intake: Intake) -> FloatArray:
    """What an offset or scale factor that is a finding adds [°/s], by the compensator itself."""
    terms = coefficient_terms(diagnosis)
    rate = np.nan_to_num(intake.recording["rate_dps"])
    return predict(new_model(terms=terms), rate, np.zeros_like(rate)).error_dps


def _times(recording: Recording) -> FloatArray:
    """The recording's own times, missing ones bridged; row numbers for points."""
    rows = np.arange(len(recording), dtype=float)
    t = recording.get("t_s")
    if t is None:
        return rows
    good = np.isfinite(t)
    return np.interp(rows, rows[good], t[good]) if good.any() else rows


def _table(t: FloatArray, correction: FloatArray) -> bytes:
    import pyarrow as pa
    import pyarrow.csv

    sink = pa.BufferOutputStream()
    sink.write(b"t_s,correction_dps\n")
    table = pa.table({"t_s": t, "correction_dps": np.nan_to_num(correction)})
    pyarrow.csv.write_csv(table, sink, pyarrow.csv.WriteOptions(include_header=False))
    return sink.getvalue().to_pybytes()
