"""Which samples share their error: whole recordings, whole soaks, or, in one recording over time, whole blocks."""

from collections.abc import Sequence

import numpy as np

from training.table import Recording

BLOCKS = 20
SAME_SOAK_K = 1.0


def soaks(temp_degC: np.ndarray) -> np.ndarray:
    """Index of the soak of every rate-table point, in the order given: a new one where the temperature steps."""
    steps = np.abs(np.diff(temp_degC)) > SAME_SOAK_K
    return np.concatenate([[0], np.cumsum(steps)])


def blocks(rows: int) -> np.ndarray:
    """Index of the block of every row: BLOCKS runs of equal length (of fewer rows, as many as there are).

    Counted in rows, not seconds: the same frames received with another jitter are the same blocks, so a model trained
    from the bus is the model trained from the file.
    """
    return np.arange(rows) * BLOCKS // max(rows, 1) if rows >= BLOCKS else np.arange(rows)


def groups_of(recordings: Sequence[Recording], whole: bool = False) -> tuple[np.ndarray, str]:
    """Group of every row of the recordings put end to end, and what a group is.

    Several recordings: each is one group. One without time: its soaks. One over time: its `blocks`. `whole` False
    lets several rate tables count by soak, too.
    """
    timed = any("t_s" in recording for recording in recordings)
    if len(recordings) > 1 and (whole or timed):
        return np.repeat(np.arange(len(recordings)), [len(r) for r in recordings]), "recording"
    if not timed:
        parts, first = [], 0
        for recording in recordings:
            parts.append(soaks(recording["temp_degC"]) + first)
            first = int(parts[-1][-1]) + 1
        return np.concatenate(parts), "soak"
    return blocks(len(recordings[0])), "block"
