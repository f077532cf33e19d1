"""diagnosis.rrd: the recordings before and after, their drivers and the findings, for the viewer."""

import logging
from importlib import util
from pathlib import Path

import numpy as np

from training.diagnose.document import Diagnosis
from training.diagnose.pipeline import Analysis, residual_after
from training.diagnose.prove import cleared

logger = logging.getLogger(__name__)


def series(analysis: Analysis) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """{path: (t_s, values)} of every curve, at the working rate."""
    curves: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for index, intake in enumerate(analysis.intakes):
        work, name = intake.work, intake.recording.name
        rows = np.ones(len(work), dtype=bool)
        curves[f"{name}/error_before_dps"] = (work.t, cleared(work.y, work.w, rows))
        curves[f"{name}/error_after_dps"] = (work.t, residual_after(analysis, index))
        curves[f"{name}/temperature_degC"] = (work.t, work.temp)
        curves[f"{name}/true_rate_dps"] = (work.t, work.w)
    return curves


def save_rerun(analysis: Analysis, diagnosis: Diagnosis, path: Path) -> None:
    """Write the recording with the viewer's own writer where that is installed, else with this one."""
    if util.find_spec("rtcomp.view") is not None and util.find_spec("rtcomp.view.files") is not None:
        from rtcomp.view import files  # type: ignore[attr-defined]

        if hasattr(files, "save_diagnosis"):  # the one call site of the viewer
            files.save_diagnosis(
                path, series(analysis), diagnosis.sentence, [f.text for f in diagnosis.findings]
            )
            return
    _save(analysis, diagnosis, path)


def _save(analysis: Analysis, diagnosis: Diagnosis, path: Path) -> None:
    import rerun as rr

    stream = rr.RecordingStream("rtcomp_diagnosis")
    stream.save(str(path))
    stream.log("verdict", rr.TextDocument(diagnosis.sentence), static=True)
    lines = [f"- **{f.effect}** ({f.status}): {f.text}, {f.rms_dps:.3g} °/s rms" for f in diagnosis.findings]
    stream.log(
        "findings", rr.TextDocument("\n".join(lines) or "none", media_type="text/markdown"), static=True
    )
    for name, (t, values) in series(analysis).items():
        stream.send_columns(
            name, [rr.TimeColumn("t", duration=t)], columns=rr.Scalars.columns(scalars=values)
        )
    stream.flush()
    stream.disconnect()
