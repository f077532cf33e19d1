"""From files: a model, a recording, a diagnosis, a paper run, logged by the same functions as the live stream."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtcomp.compensator import predict
from rtcomp.errors import RequestError
from rtcomp.frames import CORRECTED, Flag
from rtcomp.model import Model
from rtcomp.view import colours
from rtcomp.view.cells import Cells
from rtcomp.view.channel_scene import SIDES, ChannelScene, fitting_box, log_model_scene, style_operating_point
from rtcomp.view.columns import Elapsed
from rtcomp.view.layout import diagnosis_blueprint, live_blueprint, surfaces_blueprint
from rtcomp.view.report import about_diagnosis, about_models
from rtcomp.view.rerun_sdk import load_rerun
from rtcomp.view.scene import Box, log_axes, magnified, make_box
from rtcomp.view.sinks import open_sink
from rtcomp.view.streams import ChannelStreams, error_columns
from rtcomp.view.surface import Grid, log_points, log_surface, log_tiles

BLOCKS = 400  # pieces of a recording: as often the operating point moves
NOTHING = np.zeros(0)


def save_model(models: Model | Sequence[Model], path: str | Path, name: str = "model") -> None:
    """Write an .rrd with a model's surface, rules and validity."""
    with open_sink(save=path) as sink:
        log_model(sink.stream, [models] if isinstance(models, Model) else models, name)


def save_recording(recording: Any, path: str | Path, models: Sequence[Model] = ()) -> None:
    """Write an .rrd with a recording (`training.table.Recording`) before and after the models."""
    with open_sink(save=path) as sink:
        log_recordings(sink.stream, [recording], models)


def save_diagnosis(
    path: str | Path, curves: Mapping[str, Any], sentence: str, texts: Sequence[str] = ()
) -> None:
    """Write an .rrd with a diagnosis; arguments as of `log_diagnosis`."""
    with open_sink(save=path) as sink:
        log_diagnosis(sink.stream, curves, sentence, texts)


def save_paper(shown: Any, path: str | Path) -> None:
    """Write an .rrd with both figures of a paper run (`training.paper_figures.Surfaces`)."""
    with open_sink(save=path) as sink:
        log_paper(sink.stream, shown)


def log_model(stream: Any, models: Sequence[Model], name: str) -> None:
    """Log a stack of models: the error it predicts, and what it expects to leave."""
    box = fitting_box(models, NOTHING, NOTHING, NOTHING)
    log_model_scene(stream, f"{name}/surface", models, box)
    log_text(stream, f"{name}/about", about_models(name, models))
    stream.send_blueprint(surfaces_blueprint([name]))


def log_recordings(stream: Any, recordings: Sequence[Any], models: Sequence[Model] = ()) -> None:
    """Log recordings: streams over time where they have one, else points of a rate table on the surface.

    Raises RequestError for a recording without rate or temperature.
    """
    timed = [recording for recording in recordings if "t_s" in recording]
    for recording in recordings:
        _log_recording(stream, recording, models)
    names = [recording.name for recording in recordings]
    whole = live_blueprint(names, None) if len(timed) == len(recordings) else surfaces_blueprint(names, SIDES)
    stream.send_blueprint(whole)


def _log_recording(stream: Any, recording: Any, models: Sequence[Model]) -> None:
    samples, name = corrected_samples(recording, models), recording.name
    scene = ChannelScene(stream, name, models, Elapsed)
    box = scene.prepare(samples)
    log_text(stream, f"{name}/about", about_models(name, models))
    if "t_s" in recording:
        style_operating_point(stream, f"{name}/surface")
        streams = ChannelStreams(stream, name, Elapsed)
        for block in _blocks(samples):
            streams.add(block)
            scene.add(block)
    else:
        _log_points(stream, name, samples, box, bool(models))
    scene.finish()


def _log_points(stream: Any, name: str, samples: np.ndarray, box: Box, on_surface: bool) -> None:
    before, after = error_columns(samples).T
    known = np.isfinite(after)
    if not known.any():
        return
    scale = magnified(box, float(np.abs(after[known]).max()))
    log_axes(stream, f"{name}/surface/magnified/axes", scale)
    place = samples["temp_degC"][known], samples["rate_raw_dps"][known]
    for side, error, own in (("before", before, box), ("after", after, box), ("magnified", after, scale)):
        plain = colours.POINTS if on_surface and side == "before" else None
        log_points(stream, f"{name}/surface/{side}/points", *place, error[known], own, plain)


def _blocks(samples: np.ndarray) -> Iterator[np.ndarray]:
    length = max(len(samples) // BLOCKS, 25)
    for start in range(0, len(samples), length):
        yield samples[start : start + length]


def corrected_samples(recording: Any, models: Sequence[Model]) -> np.ndarray:
    """A recording as CORRECTED samples, run through the compiled step; time 0 is 1970 in the viewer.

    Raises RequestError where rate or temperature are missing.
    """
    missing = [column for column in ("rate_dps", "temp_degC") if column not in recording]
    if missing:
        raise RequestError(
            f"{recording.name}: no column {missing[0]}; a surface needs rate_dps and temp_degC"
        )
    rate, temp, t_s = recording["rate_dps"], recording["temp_degC"], recording.get("t_s")
    samples = np.zeros(len(rate), CORRECTED)
    samples["seq"] = np.arange(len(rate))
    samples["t_ns"] = samples["t_pub_ns"] = 0 if t_s is None else np.rint(t_s * 1e9)
    samples["rate_raw_dps"], samples["temp_degC"], samples["sigma_dps"] = rate, temp, np.nan
    samples["ref_rate_dps"] = np.nan if recording.get("ref_rate_dps") is None else recording["ref_rate_dps"]
    samples["flags"] = 0 if models else int(Flag.NO_MODEL)
    if models:
        told = predict(list(models), rate, temp, t_s, recording.get("coil_temp_degC"))
        samples["correction_dps"], samples["sigma_dps"], samples["flags"] = (
            told.error_dps,
            told.sigma_dps,
            told.flags,
        )
    samples["rate_dps"] = rate - samples["correction_dps"]
    return samples


def log_diagnosis(stream: Any, curves: Mapping[str, Any], sentence: str, texts: Sequence[str] = ()) -> None:
    """Log a diagnosis: curves over time, the mismatch over temperature and rate, and the verdict.

    Args:
        stream: an open recording stream.
        curves: `RECORDING/quantity` → (t_s, values), shape `(n,)` each; quantities are error_before_dps,
            error_after_dps, temperature_degC, true_rate_dps, any may be absent.
        sentence: the verdict for a person.
        texts: one line per finding.
    """
    names = sorted({path.rsplit("/", 1)[0] for path in curves})
    for name in names:
        own = {
            path.rsplit("/", 1)[1]: curve for path, curve in curves.items() if path.rsplit("/", 1)[0] == name
        }
        ChannelStreams(stream, name).curves(own)
        _log_mismatch(stream, name, own)
    log_text(stream, "verdict", about_diagnosis(sentence, texts))
    stream.send_blueprint(diagnosis_blueprint(names))


def _log_mismatch(stream: Any, name: str, own: Mapping[str, Any]) -> None:
    """Mean mismatch per cell of temperature and rate, before and after what was found is taken away."""
    if any(key not in own for key in ("error_before_dps", "temperature_degC", "true_rate_dps")):
        return
    temp, rate = own["temperature_degC"][1], own["true_rate_dps"][1]
    before = own["error_before_dps"][1]
    after = own["error_after_dps"][1] if "error_after_dps" in own else np.full(len(before), np.nan)
    known = np.isfinite(temp) & np.isfinite(rate) & np.isfinite(before)
    if not known.any():
        return
    largest = float(np.quantile(np.abs(before[known]), 0.98))
    seen, turned = temp[known], rate[known]
    box = make_box((seen.min(), seen.max()), (turned.min(), turned.max()), largest)
    cells = Cells(box)
    cells.add(temp, rate, np.stack([before, np.where(np.isfinite(after), after, 0.0)], axis=-1))
    grids = dict(zip(SIDES, (*cells.means(), cells.means()[1]), strict=True))
    left = np.abs(grids["magnified"].error_dps)
    boxes = {"before": box, "after": box, "magnified": magnified(box, float(np.nanmax(left)))}
    for side, grid in grids.items():
        log_axes(stream, f"{name}/surface/{side}/axes", boxes[side])
        log_tiles(stream, f"{name}/surface/{side}/measured", grid, boxes[side])


def log_paper(stream: Any, shown: Any) -> None:
    """Log figures 1 and 2 of a paper run on one scale, and figure 2 magnified to its own."""
    name = "paper"
    spans = (
        (float(shown.temp_degC.min()), float(shown.temp_degC.max())),
        (
            float(shown.rate_dps.min()),
            float(shown.rate_dps.max()),
        ),
    )
    before = Grid(shown.temp_degC, shown.rate_dps, shown.before_dps)
    after = Grid(shown.left_temp_degC, shown.left_rate_dps, shown.left_dps)
    scales = {"before": _largest(before), "after": _largest(before), "magnified": _largest(after)}
    for (side, limit), grid in zip(scales.items(), (before, after, after), strict=True):
        box: Box = make_box(*spans, limit)
        log_axes(stream, f"{name}/surface/{side}/axes", box)
        log_surface(stream, f"{name}/surface/{side}/error", grid, box)
    told = (
        f"## Simulated rate table, seed {shown.seed}\n\nMethod: {shown.method}. Largest error before "
        f"{scales['before']:.4g} °/s, left {scales['magnified']:.4g} °/s."
    )
    log_text(stream, f"{name}/about", told)
    stream.send_blueprint(surfaces_blueprint([name], tuple(scales)))


def _largest(grid: Grid) -> float:
    return float(np.nanmax(np.abs(grid.error_dps)))


def log_text(stream: Any, path: str, markdown: str) -> None:
    """Log a text beside the pictures."""
    stream.log(path, load_rerun().TextDocument(markdown, media_type="text/markdown"), static=True)
