"""diagnosis.rrd: the recordings before and after, their drivers and the findings, for the viewer."""

import logging
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
    """Write the recording, by the viewer's own writer."""
    from rtcomp.view.files import save_diagnosis

    save_diagnosis(path, series(analysis), diagnosis.sentence, [f.text for f in diagnosis.findings])
