"""`rtcomp diagnose` without its command line: files in, a folder of files out."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rtcomp.errors import RequestError
from training.diagnose.document import Diagnosis, to_json, write_text
from training.diagnose.extended import save_extended
from training.diagnose.pipeline import Analysis, Progress, analyse
from training.diagnose.settings import Settings
from training.diagnose.simulation import choose_simulation
from training.diagnose.verdict import conclude
from training.table import Recording, read_recording


def run_diagnose(
    recordings: Sequence[Path],
    out: Path,
    heldout: Sequence[Path] = (),
    simulation: Path | None = None,
    settings: Settings | None = None,
    columns: Mapping[str, str] | None = None,
    dbc: Path | None = None,
    signal_map: str | None = None,
    progress: Progress = lambda stage: None,
) -> Diagnosis:
    """Diagnose recordings and write diagnosis.json, report.html, extended.json, diagnosis.rrd and heldout/*.csv.

    Raises RequestError for input that cannot be diagnosed (no truth, mixed kinds, unreadable files).
    """
    settings = settings or Settings()
    if not recordings:
        raise RequestError("no recording given; name at least one table or CAN log")
    progress("read")
    tables = [read_recording(p, columns, dbc, signal_map) for p in recordings]
    unseen = [read_recording(p, columns, dbc, signal_map) for p in heldout]
    _distinct([*tables, *unseen])
    chosen = choose_simulation(simulation, [dict(t.columns) for t in [*tables, *unseen]])
    analysis = analyse(tables, unseen, chosen, settings, progress)
    diagnosis = conclude(analysis)
    progress("write")
    write_all(analysis, diagnosis, out)
    return diagnosis


def _distinct(tables: Sequence[Recording]) -> None:
    hashes = [t.sha256 for t in tables if t.sha256]
    if len(set(hashes)) < len(hashes):
        raise RequestError(
            "the same recording was given twice (as fit and held out, or twice); give each file once"
        )


def write_all(analysis: Analysis, diagnosis: Diagnosis, out: Path) -> None:
    """Write every file of the folder, each whole or not at all."""
    from training.diagnose.report import report_html
    from training.diagnose.rerun_recording import save_rerun

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(
            f"cannot make folder {out}: {error.strerror}; give a folder that can be written to"
        ) from error
    write_text(out / "diagnosis.json", to_json(diagnosis) + "\n")
    save_extended(analysis, diagnosis, out / "extended.json")
    write_heldout(analysis, out)
    write_text(out / "report.html", report_html(analysis, diagnosis))
    save_rerun(analysis, diagnosis, out / "diagnosis.rrd")


def write_heldout(analysis: Analysis, out: Path) -> None:
    """heldout/NAME.csv: the predicted effect on every row of every held-out recording."""
    if not analysis.heldout:
        return
    folder = out / "heldout"
    folder.mkdir(exist_ok=True)
    for intake, proof in zip(analysis.heldout, analysis.proofs, strict=True):
        write_text(
            folder / f"{intake.recording.name}.csv", _csv(intake.checked.columns.get("t_s"), proof.prediction)
        )


def _csv(t: np.ndarray | None, correction: np.ndarray) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["t_s", "correction_dps"])
    times = np.arange(len(correction), dtype=float) if t is None else t
    writer.writerows(
        [f"{a:.9g}" if t is None else f"{a:.6f}", f"{b:.9g}"] for a, b in zip(times, correction, strict=True)
    )
    return buffer.getvalue()
