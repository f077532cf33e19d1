"""How the viewer opens: per sensor the two surfaces on the left, the streams on the right."""

from collections.abc import Sequence
from typing import Any

from rtcomp.view.rerun_sdk import TIMELINE, load_rerun
from rtcomp.view.streams import SERIES

BACKGROUND = (22, 25, 32, 255)
EYE, TARGET = (1.87, -2.3, 1.36), (0.05, -0.04, -0.15)  # the whole box with its labels


def live_blueprint(names: Sequence[str], window_s: float | None = 30.0) -> Any:
    """The blueprint for streams of these channels; `window_s` is how much of the past plots show (None: all)."""
    rrb = _blueprint_module()
    pages = [_sensor_page(name, window_s) for name in names]
    root = pages[0] if len(pages) == 1 else rrb.Tabs(*pages)
    return rrb.Blueprint(root, *_panels())


def surfaces_blueprint(names: Sequence[str], titles: Sequence[str] = ("before", "after")) -> Any:
    """The blueprint for surfaces without streams: a model, a paper run."""
    rrb = _blueprint_module()
    pages = []
    for name in names:
        scenes = [_scene_view(f"{name}/surface/{side}", _title(name, side)) for side in titles]
        about = rrb.TextDocumentView(origin=f"{name}/about", name="about")
        if len(scenes) == 2:
            pages.append(rrb.Horizontal(rrb.Vertical(*scenes), about, column_shares=[3, 1], name=name))
        else:
            pages.append(rrb.Grid(*scenes, about, grid_columns=2, name=name))
    root = pages[0] if len(pages) == 1 else rrb.Tabs(*pages)
    return rrb.Blueprint(root, *_panels("hidden"))


def diagnosis_blueprint(names: Sequence[str]) -> Any:
    """The blueprint of a diagnosis: per recording the mismatch over its drivers and over time; the verdict below."""
    rrb = _blueprint_module()
    pages = []
    for name in names:
        titles = {"before": "mismatch before", "after": "mismatch after", "magnified": "after, magnified"}
        views = [_scene_view(f"{name}/surface/{k}", f"{name}: {title}") for k, title in titles.items()]
        scenes = [views[0], rrb.Tabs(*views[1:])]
        entities = {
            "error": "mismatch [°/s]",
            "temperature": "temperature [°C]",
            "true_rate": "true rate [°/s]",
        }
        plots = rrb.Vertical(*[_plot(name, entity, title, None) for entity, title in entities.items()])
        pages.append(rrb.Horizontal(rrb.Vertical(*scenes), plots, name=name))
    shown = pages[0] if len(pages) == 1 else rrb.Tabs(*pages) if pages else rrb.Tabs()
    verdict = rrb.TextDocumentView(origin="verdict", name="verdict")
    root = rrb.Vertical(shown, verdict, row_shares=[4, 1]) if pages else verdict
    return rrb.Blueprint(root, *_panels())


def _blueprint_module() -> Any:
    load_rerun()
    import rerun.blueprint as rrb

    return rrb


def _panels(time: Any = "collapsed") -> tuple[Any, ...]:
    """Nothing but the views and a line of time, which shows the latest there is."""
    rrb = _blueprint_module()
    return (
        rrb.TimePanel(state=time, timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TopPanel(state="collapsed"),
    )


def _sensor_page(name: str, window_s: float | None) -> Any:
    rrb = _blueprint_module()
    surfaces = rrb.Vertical(
        _scene_view(f"{name}/surface/before", _title(name, "before")),
        rrb.Tabs(
            *[_scene_view(f"{name}/surface/{side}", _title(name, side)) for side in ("after", "magnified")]
        ),
    )
    streams = rrb.Vertical(
        rrb.Horizontal(
            _plot(name, "rate", "rate [°/s]", window_s),
            _plot(name, "error", "error against the reference [°/s]", window_s),
        ),
        rrb.Horizontal(
            _plot(name, "correction", "correction ± σ [°/s]", window_s),
            _plot(name, "temperature", "temperature [°C]", window_s),
            _plot(name, "temperature_rate", "dT/dt [°C/min]", window_s),
            column_shares=[2, 1, 1],
        ),
        _running(name, window_s),
        row_shares=[1.2, 1.1, 0.85 if window_s is not None else 0.6],
    )
    return rrb.Horizontal(surfaces, streams, column_shares=[1, 1.3], name=name)


def _running(name: str, window_s: float | None) -> Any:
    """The flags; and of a stream that comes live, its health and its whole past."""
    rrb = _blueprint_module()
    status = rrb.StateTimelineView(origin=f"{name}/status", name="status")
    about = rrb.TextDocumentView(origin=f"{name}/about", name="model")
    if window_s is None:
        return rrb.Tabs(status, about)
    past = [
        _plot(name, "history/error", "whole run: rms error [°/s]", None),
        _plot(name, "history/correction", "correction", None),
        _plot(name, "history/temperature", "temperature", None),
    ]
    latency = [
        _plot(name, f"latency/{p}", title, None)
        for p, title in {"p50": "latency p50 [µs]", "p99": "p99 [µs]"}.items()
    ]
    losses = _plot(name, "losses", "samples lost, in all", None)
    return rrb.Horizontal(
        rrb.Tabs(status, *past, about), rrb.Tabs(*latency), losses, column_shares=[1.4, 1.35, 1.25]
    )


def _title(name: str, side: str) -> str:
    told = {
        "before": "error before compensation",
        "after": "error left after compensation",
        "magnified": "error left, magnified",
    }
    return f"{name}: {told.get(side, side)}"


def _scene_view(origin: str, title: str) -> Any:
    rrb = _blueprint_module()
    eye = rrb.EyeControls3D(
        kind="Orbital",
        position=EYE,
        look_target=TARGET,
        eye_up=(0.0, 0.0, 1.0),
    )
    hidden = rrb.LineGrid3D(visible=False)
    return rrb.Spatial3DView(
        origin=origin, name=title, background=BACKGROUND, line_grid=hidden, eye_controls=eye
    )


def _plot(name: str, entity: str, title: str, window_s: float | None) -> Any:
    rrb = _blueprint_module()
    options: dict[str, Any] = {}
    several = len(SERIES[entity][0]) > 1
    whole = rrb.TimeRangeBoundary.infinite()
    options["axis_x"] = rrb.TimeAxis(view_range=rrb.TimeRange(start=whole, end=whole))
    if window_s is not None:
        past = rrb.TimeRangeBoundary.cursor_relative(seconds=-window_s)
        now = rrb.TimeRangeBoundary.cursor_relative()
        options["axis_x"] = rrb.TimeAxis(view_range=rrb.TimeRange(start=past, end=now))
        options["time_ranges"] = rrb.VisibleTimeRange(TIMELINE, start=past, end=now)
    return rrb.TimeSeriesView(
        origin=f"{name}/{entity}",
        name=title,
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=several),
        **options,
    )
