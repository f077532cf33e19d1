"""Where what is logged goes: a window on this machine, a web page on loopback, an .rrd file, or several of them."""

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rtcomp.errors import RequestError, WorkError
from rtcomp.view.page import serve_page
from rtcomp.view.rerun_sdk import APPLICATION, load_rerun, quiet_environment, rerun_program

LOOPBACK = "127.0.0.1"
MEMORY_LIMIT = "256MiB"
WEB_PORT = 9090
READY_S = 15.0
LIVE_ROWS = 1000  # rows per channel and batch of 0.1 s that a screen is given at most


class NothingShownError(WorkError):
    """There was nothing to show; a file that was begun is not kept."""


@dataclass
class Sink:
    """An open recording stream. `rows_per_batch` None means that every row is wanted (a file)."""

    stream: Any
    rows_per_batch: int | None
    url: str | None = None
    viewer: subprocess.Popen[bytes] | None = None

    def alive(self) -> bool:
        """False once the person has closed the window (or the web server has died)."""
        return self.viewer is None or self.viewer.poll() is None


class Web(NamedTuple):
    """A served web viewer: its process, where to log to, the page's address, and what ends it."""

    viewer: subprocess.Popen[bytes]
    grpc: str
    url: str
    end: Callable[[], None]


@contextlib.contextmanager
def open_sink(
    *,
    window: bool = False,
    web: bool = False,
    save: str | Path | None = None,
    bind: str = LOOPBACK,
    web_port: int = WEB_PORT,
    memory_limit: str = MEMORY_LIMIT,
    name: str | None = None,
) -> Iterator[Sink]:
    """Open a recording stream to what is asked for; at the end everything is flushed and the file put in place.

    Args:
        window: a native window; it stays open afterwards.
        web: rerun's web viewer, served on `bind` and `web_port` (0: any free one) as long as the sink is open.
        save: an .rrd file, written whole or not at all.
        bind: address on which viewer and web server listen.
        web_port: port of the web page.
        memory_limit: what the viewer may hold before it drops its oldest data (`256MiB`, `25%`).
        name: the recording's name in the viewer.

    Raises:
        RequestError: no display, a folder that cannot be written to, a memory limit rerun does not know.
        WorkError: rerun is not installed or its viewer does not start.
    """
    if not (window or web or save is not None):
        raise RequestError("nothing to show on: wanted a window, --web, or --save FILE.rrd")
    rr = load_rerun()
    stream = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
    with contextlib.ExitStack() as stack:
        sinks: list[Any] = []
        viewer, url = None, None
        if window or web:
            if web:
                served = start_web(bind, web_port, memory_limit)
                stack.callback(served.end)
                viewer, grpc, url = served.viewer, served.grpc, served.url
            else:
                viewer, grpc = start_window(bind, memory_limit)
            sinks.append(rr.GrpcSink(grpc))
        if save is not None:
            sinks.append(rr.FileSink(stack.enter_context(_replacing(Path(save)))))
        stream.set_sinks(*sinks)
        sink = Sink(stream, None if not (window or web) else LIVE_ROWS, url, viewer)
        stack.callback(_finish, sink)
        if name:
            stream.send_recording_name(name)
        yield sink


def _finish(sink: Sink) -> None:
    """Hand over what is left.

    Raises WorkError when that fails, unless it is because the person has closed the window.
    """
    try:
        sink.stream.flush(timeout_sec=5.0)
    except RuntimeError as error:
        if sink.alive():
            raise WorkError(f"rerun's viewer did not take the last of the data: {error}") from error
    finally:
        sink.stream.disconnect()


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A file beside `path` that takes its place at the end."""
    if path.suffix != ".rrd":
        raise RequestError(f"--save {path}: wanted a file that ends in .rrd")
    if not os.access(path.parent, os.W_OK):
        raise RequestError(f"cannot write {path}; give a file in a folder that exists and can be written to")
    part = path.with_name(f".{path.stem}.part.rrd")
    try:
        yield part
    except (RequestError, NothingShownError):  # after any other end what was recorded is kept
        part.unlink(missing_ok=True)
        raise
    finally:
        if part.exists():
            os.replace(part, path)


def check_display() -> None:
    """Raise RequestError where a native window cannot open."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise RequestError(
            "no display here (neither DISPLAY nor WAYLAND_DISPLAY is set); "
            "use --web and open the page in a browser, or --save FILE.rrd and open the file elsewhere"
        )


def viewer_command(web: bool, bind: str, port: int, web_port: int, memory_limit: str) -> list[str]:
    """The viewer program's command line."""
    command = [rerun_program(), "--bind", bind, "--port", str(port), "--server-memory-limit", memory_limit]
    if web:
        return [*command, "--serve-web", "--web-viewer-port", str(web_port)]
    return [*command, "--memory-limit", memory_limit, "--hide-welcome-screen", "--expect-data-soon"]


def start_window(bind: str, memory_limit: str) -> tuple[Any, str]:
    """Start the viewer program with a window; returns it and the address to log to."""
    check_display()
    port = free_port(bind)
    host = reachable(bind)
    viewer = start_program(viewer_command(False, bind, port, 0, memory_limit), [(host, port)])
    return viewer, stream_address(host, port)


def start_web(bind: str, web_port: int, memory_limit: str, files: Sequence[str] = ()) -> Web:
    """Serve the web viewer, fed by a stream (or by files), on a page of ours."""
    host = reachable(bind)
    port, inner = free_port(bind), free_port(LOOPBACK)
    command = viewer_command(True, bind, port, inner, memory_limit)
    viewer = start_program([*command, *files], [(host, port), (host, inner)])
    page = free_port(bind, web_port)
    end_page = serve_page(bind, page, f"http://{host}:{inner}", f"http://{host}:{port}")

    def end() -> None:
        end_page()
        _end(viewer)

    grpc = stream_address(host, port)
    return Web(viewer, grpc, page_address(host, page, grpc), end)


def reachable(bind: str) -> str:
    """An address at which what listens on `bind` is reached from this machine."""
    return LOOPBACK if bind in ("0.0.0.0", "::") else bind  # noqa: S104 - asked for by the person


def stream_address(host: str, port: int) -> str:
    """The address to log to."""
    return f"rerun+http://{host}:{port}/proxy"


def page_address(host: str, page_port: int, grpc: str) -> str:
    """The address of the web page that shows what is logged to `grpc`."""
    return f"http://{host}:{page_port}/?url={urllib.parse.quote(grpc, safe='')}"


def start_program(command: list[str], listening: Sequence[tuple[str, int]] = ()) -> subprocess.Popen[bytes]:
    """Start rerun's program, its analytics off, and wait until it answers at the addresses given.

    It gets a session of its own, so that Ctrl-C reaches only us.

    Raises WorkError when it ends or does not answer.
    """
    quiet = quiet_environment() | {"RUST_LOG": os.environ.get("RUST_LOG", "error")}
    with tempfile.TemporaryFile() as told:
        viewer = subprocess.Popen(  # noqa: S603 - the program that comes with the package, arguments as a list
            command,
            env=quiet,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=told,
            start_new_session=True,
        )
        deadline = time.monotonic() + READY_S
        while not all(_answers(host, port) for host, port in listening):
            if viewer.poll() is not None:
                told.seek(0)
                lines = told.read().decode(errors="replace").strip().splitlines()
                raise WorkError(
                    f"rerun's viewer ended at once ({lines[-1] if lines else 'silently'}); try --save FILE.rrd"
                )
            if time.monotonic() > deadline:
                _end(viewer)
                raise WorkError(f"rerun's viewer did not answer within {READY_S:g} s; try --save FILE.rrd")
            time.sleep(0.05)
    return viewer


def free_port(bind: str, wanted: int = 0) -> int:
    """`wanted` if nobody listens there, else any free port.

    Raises RequestError when `bind` is not an address of this machine.
    """
    for port in (wanted, 0):
        with socket.socket(socket.AF_INET6 if ":" in bind else socket.AF_INET) as probe:
            try:
                probe.bind((bind, port))
            except OSError as error:
                if port == 0:
                    raise RequestError(
                        f"--bind {bind}: {error.strerror}; give an address of this machine"
                    ) from error
                continue
            return int(probe.getsockname()[1])
    raise RequestError(f"--bind {bind}: no free port")


def _answers(host: str, port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=0.5):
        return True
    return False


def _end(viewer: subprocess.Popen[bytes]) -> None:
    viewer.terminate()
    try:
        viewer.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        viewer.kill()
        viewer.wait()
