"""The pictures of README and reports, from the viewer's own functions.

    python -m tools.pictures            # writes .github/pictures/*.png

Needs a Vulkan driver for rerun's headless viewer (Debian: mesa-vulkan-drivers libvulkan1 libxkbcommon0) and chromium.
All data in them are simulated.
"""

import os
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np

from rtcomp.demo import MODEL, Demo
from rtcomp.model import load_model
from rtcomp.run import saying_when_slow
from rtcomp.view import files
from rtcomp.view.demo import watching
from rtcomp.view.rerun_sdk import rerun_program
from rtcomp.view.sinks import LOOPBACK, free_port, start_program, stream_address
from tools import browser_shot

FOLDER = Path(__file__).parent.parent / ".github" / "pictures"
WEB_S = 75.0  # a browser that renders in software is half a minute late
SETTLE_S = 14.0  # software rendering takes its time, and the viewer's greetings have to go


def drive(folder: Path) -> Path:
    """The bundled trace through the whole chain, live, as the viewer saves it."""
    demo = Demo(seconds=45.0)
    path = folder / "drive.rrd"
    try:
        with saying_when_slow(print), watching(demo.session, "rtcomp", save=path):
            demo.run()
    finally:
        demo.close()
    return path


def model(folder: Path) -> Path:
    """The bundled model with the simulated rate table it was trained on."""
    from training.simulator.run import simulate_file
    from training.table import read_recording

    table = folder / "rate_table.csv"
    simulate_file("rate_table", table, None)
    path = folder / "model.rrd"
    files.save_recording(read_recording(table), path, [load_model(MODEL)])
    return path


def paper(folder: Path) -> Path:
    """Figures 1 and 2 of a paper run."""
    from training.paper_figures import surfaces

    files.save_paper(surfaces(), path := folder / "paper.rrd")
    return path


def diagnosis(folder: Path) -> Path:
    """A simulated drive against an ideal gyro, before and after what is missing was found."""
    from training.diagnose.run import run_diagnose
    from training.simulator.run import simulate_file

    recording = folder / "drive.csv"
    simulate_file("cold_start_drive", recording, None)
    run_diagnose([recording], folder / "diagnosis")
    return folder / "diagnosis" / "diagnosis.rrd"


def web(picture: Path, size: tuple[int, int]) -> None:
    """The web viewer in a browser, while the demo runs."""
    demo = Demo(seconds=WEB_S + 30.0)
    try:
        with saying_when_slow(print), watching(demo.session, "rtcomp", web=True) as viewer:
            running = threading.Thread(target=demo.run)
            running.start()
            try:
                browser_shot.shoot(str(viewer.sink.url), picture, WEB_S, size)
            finally:
                demo.stop()
                running.join()
    finally:
        demo.close()


FILES: dict[str, tuple[Callable[[Path], Path], tuple[int, int]]] = {
    "drive": (drive, (1600, 900)),
    "model": (model, (1400, 800)),
    "paper": (paper, (1400, 800)),
    "diagnosis": (diagnosis, (1600, 900)),
}
NAMES = (*FILES, "web")


def make(name: str, picture: Path) -> None:
    """Make one picture."""
    if name == "web":
        web(picture, (1600, 900))
    else:
        log, size = FILES[name]
        with tempfile.TemporaryDirectory() as folder:
            shoot(log(Path(folder)), picture, size)
    shrink(picture)


def shoot(rrd: Path, picture: Path, size: tuple[int, int]) -> None:
    """Let rerun's headless viewer open a file and save its picture."""
    from rerun.experimental import ViewerClient

    port = free_port(LOOPBACK)
    command = [
        rerun_program(),
        "--headless",
        "--bind",
        LOOPBACK,
        "--port",
        str(port),
        "--window-size",
        "x".join(map(str, size)),
        str(rrd),
    ]
    viewer = start_program(command, [(LOOPBACK, port)])
    try:
        client = ViewerClient.connect(stream_address(LOOPBACK, port))
        time.sleep(SETTLE_S)
        client.save_screenshot(str(picture.resolve()))
        _wait_for(picture)
    finally:
        viewer.kill()
        viewer.wait()


def _wait_for(picture: Path, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not (picture.is_file() and picture.stat().st_size):
        time.sleep(0.2)
    time.sleep(0.5)


def shrink(picture: Path) -> None:
    """Cut the empty title bar off and keep 256 colours: a third of the size, nearly the same to the eye."""
    from PIL import Image

    with Image.open(picture) as opened:
        image: Any = opened.convert("RGB")
    rows = np.flatnonzero(np.ptp(np.asarray(image).reshape(image.height, -1), axis=1) > 40)
    top = int(rows[0]) if len(rows) else 0
    image = image.crop((0, max(top - 6, 0), image.width, image.height)).quantize(256)
    image.save(picture.with_suffix(".part.png"), optimize=True)
    os.replace(picture.with_suffix(".part.png"), picture)


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(NAMES))
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), default=FOLDER, help="Folder for the pictures."
)
def main(names: tuple[str, ...], out: Path) -> None:
    """Make the pictures NAMES (all of them by default)."""
    out.mkdir(parents=True, exist_ok=True)
    for name in names or NAMES:
        make(name, out / f"{name}.png")
        click.echo(f"{out / name}.png: {(out / f'{name}.png').stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
