"""`rtcomp view` without its command line: what is asked for, the waiting for a stream, the files."""

import contextlib
import ctypes
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtcomp.errors import RequestError, WorkError
from rtcomp.model import load_model
from rtcomp.view.live import Viewer
from rtcomp.view.rerun_sdk import load_rerun
from rtcomp.view.sinks import (
    NothingShownError,
    Sink,
    check_display,
    free_port,
    open_sink,
    start_program,
    start_web,
    viewer_command,
)
from rtcomp.zenoh_session import LOCAL, open_session

Say = Callable[[str], None]
RETRY_S = 0.5
M_ARENA_MAX = -8  # malloc.h
NICE = 10  # whoever watches gives way to whoever corrects; what we start inherits it


@dataclass(frozen=True)
class ViewConfig:
    """Options of `rtcomp view`, by their names."""

    files: Sequence[str] = ()
    web: bool = False
    save: str | None = None
    zenoh: str | None = None
    prefix: str = "rtcomp"
    memory_limit: str = "256MiB"
    bind: str = "127.0.0.1"
    port: int = 9090
    window_s: float = 30.0
    wait_s: float = 30.0
    seconds: float | None = None
    signal_map: str | None = None
    channel: str | None = None
    paper: int | None = None


def run_view(config: ViewConfig, say: Say) -> dict[str, Any]:
    """Show what is asked for until it is over; returns what was shown.

    Raises RequestError or WorkError with one sentence and the way on.
    """
    load_rerun()
    window = not config.web and config.save is None
    if window:
        check_display()
    with _stopping() as stopped:
        recordings = [path for path in map(_rrd_of, config.files) if path is not None]
        if recordings:
            return _open_rrd(config, recordings, stopped, say)
        if config.files or config.paper is not None:
            return _show_files(config, window, stopped, say)
        return _show_live(config, window, stopped, say)


@contextlib.contextmanager
def _stopping() -> Iterator[threading.Event]:
    """SIGINT and SIGTERM end the viewing cleanly."""
    stopped = threading.Event()
    handlers = {n: signal.signal(n, lambda *_: stopped.set()) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stopped
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _sink(config: ViewConfig, window: bool, name: str, say: Say) -> Iterator[Sink]:
    options = {
        "bind": config.bind,
        "web_port": config.port,
        "memory_limit": config.memory_limit,
        "name": name,
    }
    with open_sink(window=window, web=config.web, save=config.save, **options) as sink:  # type: ignore[arg-type]
        if sink.url:
            say(f"open {sink.url}")
        yield sink


def _show_live(config: ViewConfig, window: bool, stopped: threading.Event, say: Say) -> dict[str, Any]:
    deadline = time.monotonic() + config.wait_s
    with contextlib.ExitStack() as stack:
        session = _wait_for_session(config, deadline, stopped, say)
        stack.callback(session.close)
        sink = stack.enter_context(_sink(config, window, config.prefix, say))
        viewer = Viewer(session, config.prefix, sink, config.window_s)
        viewer.start()
        try:
            _wait_for_samples(viewer, config, time.monotonic() + config.wait_s, stopped)
            end = time.monotonic() + config.seconds if config.seconds else float("inf")
            while viewer.running() and not stopped.wait(0.1) and time.monotonic() < end:
                pass
        finally:
            viewer.stop()
        return viewer.counts() | {"url": sink.url, "file": config.save}


def be_modest() -> None:
    """Give way to whoever corrects, and keep freed memory in two heaps instead of one per thread (glibc)."""
    with contextlib.suppress(AttributeError, OSError):
        os.nice(NICE)
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 2)


def _wait_for_session(config: ViewConfig, deadline: float, stopped: threading.Event, say: Say) -> Any:
    told = False
    while True:
        try:
            return open_session(config.zenoh or LOCAL, listen=False)
        except WorkError as error:
            if time.monotonic() >= deadline or stopped.is_set():
                raise NothingShownError(_no_stream(config)) from error
        if not told:
            say(
                f"no stream yet, waiting {config.wait_s:g} s for one; start it with `rtcomp run … --zenoh local`"
            )
            told = True
        stopped.wait(RETRY_S)


def _wait_for_samples(viewer: Viewer, config: ViewConfig, deadline: float, stopped: threading.Event) -> None:
    while viewer.running() and not viewer.seen() and not stopped.is_set():
        if time.monotonic() >= deadline:
            raise NothingShownError(_no_stream(config))
        stopped.wait(0.05)


def _no_stream(config: ViewConfig) -> str:
    return (
        f"no stream under {config.prefix}/ within {config.wait_s:g} s; start one with "
        "`rtcomp run --bus … --zenoh local` (or name its --zenoh and --prefix here), or see `rtcomp demo --view`"
    )


def _rrd_of(name: str) -> Path | None:
    path = Path(name)
    if path.is_dir():
        inside = path / "diagnosis.rrd"
        if not inside.is_file():
            raise RequestError(
                f"{path}: no diagnosis.rrd in this folder; wanted what `rtcomp diagnose --out` wrote"
            )
        return inside
    return path if path.suffix == ".rrd" else None


def _open_rrd(config: ViewConfig, paths: list[Path], stopped: threading.Event, say: Say) -> dict[str, Any]:
    """Let rerun's own program open its own files."""
    if config.save is not None:
        raise RequestError(
            f"--save {config.save}: {paths[0]} is an .rrd file already; give --web, or nothing"
        )
    files = [str(path.resolve()) for path in paths]
    if config.web:
        served = start_web(config.bind, config.port, config.memory_limit, files)
        say(f"open {served.url}")
        try:
            _stay(config, stopped, lambda: served.viewer.poll() is None)
        finally:
            served.end()
        return {"files": files, "url": served.url}
    start_program(
        [*viewer_command(False, config.bind, free_port(config.bind), 0, config.memory_limit), *files]
    )
    return {"files": files, "url": None}


def _stay(config: ViewConfig, stopped: threading.Event, alive: Callable[[], bool]) -> None:
    """Stay while a page is served; a window needs us no longer."""
    end = time.monotonic() + (config.seconds or float("inf"))
    while config.web and alive() and not stopped.wait(0.1) and time.monotonic() < end:
        pass


def _show_files(config: ViewConfig, window: bool, stopped: threading.Event, say: Say) -> dict[str, Any]:
    logged = _loaded(config)
    with _sink(config, window, "rtcomp", say) as sink:
        logged(sink.stream)
        sink.stream.flush()
        _stay(config, stopped, sink.alive)
        return {"files": list(config.files), "url": sink.url, "file": config.save}


def _loaded(config: ViewConfig) -> Callable[[Any], None]:
    """Read the files, before anything opens; returns what logs them."""
    from rtcomp.view import files

    if config.paper is not None:
        from training.paper_figures import surfaces

        shown = surfaces(config.paper)
        return lambda stream: files.log_paper(stream, shown)
    names = [name for name in config.files if name.endswith(".json")]
    models = [_model(name) for name in names]
    others = [name for name in config.files if name not in names]
    if not others:
        return lambda stream: files.log_model(stream, models, Path(names[0]).stem)
    recordings = [_recording(name, config) for name in others]
    return lambda stream: files.log_recordings(stream, recordings, models)


def _model(name: str) -> Any:
    if Path(name).name == "diagnosis.json":
        raise RequestError(
            f"{name} is a diagnosis; give its folder, {Path(name).parent}, which holds diagnosis.rrd too"
        )
    return load_model(name)


def _recording(name: str, config: ViewConfig) -> Any:
    from training.table import read_recording

    return read_recording(
        name, None, None, config.signal_map, config.channel, require=("rate_dps", "temp_degC")
    )
