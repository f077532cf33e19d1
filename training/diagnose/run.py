"""`rtcomp diagnose` without its command line: files in, a folder of files out."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rtcomp.atomic import write_atomically
from training.diagnose.document import Diagnosis, to_json
from training.diagnose.extended import save_extended
from training.diagnose.folder import staged
from training.diagnose.heldout import write_heldout
from training.diagnose.pipeline import Analysis, Progress, analyse
from training.diagnose.request import check_request
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
    channel: str | None = None,
) -> Diagnosis:
    """Diagnose recordings and write diagnosis.json, report.html, extended.json, diagnosis.rrd and heldout/*.csv.

    Raises RequestError for input that cannot be diagnosed (no truth, mixed kinds, unreadable files), before any
    long work and with nothing written.
    """
    settings = settings or Settings()
    with staged(out) as folder:
        progress("read")
        tables = [read_recording(p, columns, dbc, signal_map, channel) for p in recordings]
        unseen = [read_recording(p, columns, dbc, signal_map, channel) for p in heldout]
        tables, unseen = check_request(tables, unseen, settings, columns)
        chosen = choose_simulation(simulation, [dict(t.columns) for t in [*tables, *unseen]])
        analysis = analyse(tables, unseen, chosen, settings, progress)
        diagnosis = conclude(analysis)
        progress("write")
        write_all(analysis, diagnosis, unseen, folder)
    return diagnosis


def write_all(analysis: Analysis, diagnosis: Diagnosis, heldout: Sequence[Recording], folder: Path) -> None:
    """Write every file of the folder."""
    from training.diagnose.report import report_html
    from training.diagnose.rerun_recording import save_rerun

    write_atomically(folder / "diagnosis.json", (to_json(diagnosis) + "\n").encode())
    save_extended(analysis, diagnosis, folder / "extended.json")
    write_heldout(analysis, diagnosis, heldout, folder / "heldout")
    write_atomically(folder / "report.html", report_html(analysis, diagnosis).encode())
    save_rerun(analysis, diagnosis, folder / "diagnosis.rrd")
