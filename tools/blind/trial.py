"""One trial: make and seal every case, then run the tool on all of them, then open the truths and score."""

import json
import logging
import os
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rtcomp.errors import RequestError
from tools.blind.cases import make_case, plan
from tools.blind.runner import Outcome, run_case
from tools.blind.score import score, score_heldout, score_where
from tools.blind.sealing import open_case, read_seals, write_case, write_seals

logger = logging.getLogger(__name__)
Document = dict[str, Any]
Told = Callable[[str, int, int], None]


def make_and_write(name: str, level: str, turn: int, seed: int, root: Path) -> str:
    """Make one case in its folder and return its seal."""
    return write_case(make_case(name, level, turn, seed), root / name)


def run_and_keep(folder: Path) -> Outcome:
    """Run the tool on one case and keep how it went in outcome.json; a finished case is not run again."""
    path = folder / "outcome.json"
    if path.is_file():
        kept = json.loads(path.read_bytes())
        found = folder / "found" / "diagnosis.json"
        return Outcome(**kept, document=json.loads(found.read_bytes()) if kept["status"] == "done" else None)
    outcome = run_case(folder)
    keep_outcome(folder, outcome)
    return outcome


def keep_outcome(folder: Path, outcome: Outcome) -> None:
    """Write outcome.json, whole or not at all."""
    kept = {key: value for key, value in asdict(outcome).items() if key != "document"}
    temporary = folder / ".outcome.json"
    temporary.write_text(json.dumps(kept))
    os.replace(temporary, folder / "outcome.json")


def in_parallel(
    jobs: int, work: Callable[..., Any], tasks: dict[str, tuple[Any, ...]], told: Told
) -> Iterator[tuple[str, Future[Any]]]:
    """Run work(*task) for every named task in processes and yield each as it finishes."""
    with ProcessPoolExecutor(jobs) as pool:
        futures = {pool.submit(work, *task): name for name, task in tasks.items()}
        for done, future in enumerate(as_completed(futures), 1):
            told(work.__name__, done, len(futures))
            yield futures[future], future


def seal_cases(
    root: Path, cases: int, seed: int, levels: tuple[str, ...], jobs: int, told: Told
) -> tuple[Document, str]:
    """All cases made and sealed, or the seals of an earlier, identical request in the same folder."""
    header = {"seed": seed, "count": cases, "levels": list(levels)}
    earlier = read_seals(root)
    if earlier is not None:
        if {key: earlier[key] for key in header} != header:
            raise RequestError(
                f"{root} holds another trial ({earlier['count']} cases, seed {earlier['seed']}); give another --keep"
            )
        return earlier, write_seals(earlier["cases"], header, root)
    tasks = {name: (name, level, turn, seed, root) for name, level, turn in plan(cases, seed, levels)}
    seals = {name: future.result() for name, future in in_parallel(jobs, make_and_write, tasks, told)}
    return header | {"cases": seals}, write_seals(seals, header, root)


def run_tool(root: Path, names: list[str], jobs: int, told: Told) -> dict[str, Outcome]:
    """The tool on every case. A crash is an outcome as well: "crashed", with the end of its traceback."""
    outcomes = {}
    for name, future in in_parallel(jobs, run_and_keep, {name: (root / name,) for name in names}, told):
        error = future.exception()
        if error is None:
            outcomes[name] = future.result()
            continue
        words = "".join(traceback.format_exception(error)).strip().splitlines()
        logger.warning("%s: the tool crashed: %s", name, words[-1])
        outcomes[name] = Outcome("crashed", " | ".join(words[-3:])[:600], 0.0, None)
        keep_outcome(root / name, outcomes[name])
    return dict(sorted(outcomes.items()))


def score_case(folder: Path, seal: str, outcome: Outcome) -> Document:
    """Open one sealed truth and score the outcome."""
    truth, arrays = open_case(folder, seal)
    said = score(truth, outcome.document, outcome.status)
    said |= {"seconds": outcome.seconds, "message": outcome.message}
    said["heldout"] = score_heldout(folder, truth, arrays) if outcome.document else []
    said["overlap"] = score_where(folder, truth, arrays, outcome.document)
    return said
