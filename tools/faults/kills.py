"""The process killed at random moments: what it leaves behind is whole, and the next one carries on.

The parent compiles once and forks, so a restart costs little; every child is a whole run on a virtual bus, with its
states written ten times a second, killed by SIGKILL somewhere in twice the time that the first one took to begin (a
second at least). The model's lag is long, so that states are fresh however slow a restart is.
"""

import os
import random
import select
import signal
import threading
import time
from pathlib import Path
from typing import Any

from rtcomp.checkpoint import decode
from rtcomp.errors import RequestError
from rtcomp.model import Term
from rtcomp.run import warm_up
from rtcomp.sources.candump import read_candump
from tools.faults.runs import Context, Documents, fault, model_file
from tools.faults.trace import compiled_strict_map, make_trace

FULL, QUICK = 200, 5
PERIOD_S = 0.1
LONGEST_S = 1.0
FORGOTTEN_S = 600.0  # after which a run ends that nobody is left to kill


def _child(folder: Path, model: Path, told: int) -> None:
    """Run until killed; tells what became of the states as soon as the first frames are taken."""
    import rtcomp.checkpoint
    from rtcomp.config import RunConfig
    from rtcomp.run import Runner
    from rtcomp.sources.bus import open_can
    from rtcomp.sources.transmit import replay

    rtcomp.checkpoint.PERIOD_S = PERIOD_S
    config = RunConfig(
        bus=f"virtual:kill-{os.getpid()}",
        model=[str(model)],
        state=str(folder / "state.json"),
        record=str(folder / "kept.log"),
        seconds=FORGOTTEN_S,
    )
    runner = Runner(config)
    runner.start()

    def feed() -> None:
        with open_can(str(config.bus)) as bus:
            replay([make_trace().frames()], bus, speed=1.0, stop=threading.Event())

    def tell() -> None:
        while not runner.pipeline.counts["frames"]:
            time.sleep(0.002)
        counts = runner.checkpoint.counts if runner.checkpoint else {}
        os.write(told, f"{counts['restored']}{counts['refused']}".encode())

    threading.Thread(target=feed, daemon=True).start()
    threading.Thread(target=tell, daemon=True).start()
    runner.loop()


def _life(folder: Path, model: Path, lasts_s: float | None) -> str:
    """One run from start to kill, or until it has begun; what it told."""
    listen, told = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(listen)
        try:
            _child(folder, model, told)
        finally:
            os._exit(1)
    os.close(told)
    with os.fdopen(listen, "rb") as pipe:
        if lasts_s is None:
            select.select([pipe], [], [], 60.0)
        else:
            time.sleep(lasts_s)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        said = pipe.read().decode()
    return said if os.WTERMSIG(status) == signal.SIGKILL else "crashed"


def _readable(path: Path) -> bool:
    """An unfinished recording is a log: all lines but a torn last one are frames."""
    if not path.exists() or path.stat().st_size == 0:
        return True
    reader = read_candump(path)
    try:
        for _ in reader:
            pass
    except RequestError:
        return path.stat().st_size < 100
    return reader.skipped <= 1


@fault("killed at random moments")
def kills(context: Context) -> Documents:
    """Kill, look, restart, as often as it says."""
    times = QUICK if context.quick else FULL
    warm_up(compiled_strict_map())
    dice, longest_s = random.Random(20), None
    slow = Term("thermal_lag", {"tau_s": 1000.0, "bias_dps_per_K": 0.1})
    model, state = model_file(context, terms=[slow]), context.folder / "state.json"
    got: dict[str, Any] = {"kills": 0, "crashed": 0, "states_corrupt": 0, "states_refused": 0, "logs_torn": 0}
    restored = begun = 0
    for _ in range(times):
        known = state.exists()
        started = time.monotonic()
        said = _life(context.folder, model, longest_s and dice.uniform(0.0, longest_s))
        longest_s = longest_s or max(LONGEST_S, 2.0 * (time.monotonic() - started))
        got["kills"] += 1
        got["crashed"] += said == "crashed"
        got["states_refused"] += said == "01"
        restored += said == "10"
        begun += known and said in ("00", "01", "10")
        if state.exists():
            try:
                decode(state.read_bytes())
            except RequestError:
                got["states_corrupt"] += 1
        got["logs_torn"] += not _readable(context.folder / "kept.log.part")
    left = len(list(context.folder.glob(".state.json.*")))
    got |= {
        "restored_all_that_began": restored == begun,
        "some_began": begun > 0,
        "files_left_over": left > 1,
    }
    expected = {"kills": times, "crashed": 0, "states_corrupt": 0, "states_refused": 0, "logs_torn": 0}
    return expected | {"restored_all_that_began": True, "some_began": True, "files_left_over": False}, got
