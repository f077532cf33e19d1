"""Rows of numbers into rerun by columns: one call per entity and batch, Arrow arrays made straight from numpy."""

from functools import lru_cache
from typing import Any

import numpy as np

from rtcomp.view.rerun_sdk import TIMELINE, load_rerun


class Times:
    """A time column [ns UNIX]."""

    def __init__(self, t_ns: np.ndarray) -> None:
        import pyarrow

        self._array = pyarrow.array(np.ascontiguousarray(t_ns, np.int64), pyarrow.timestamp("ns"))

    def timeline_name(self) -> str:
        """The timeline's name."""
        return TIMELINE

    def as_arrow_array(self) -> Any:
        """The times."""
        return self._array


class _Column:
    """A component column whose Arrow array is there already (rerun's own builder costs four times the logging)."""

    def __init__(self, descriptor: Any, array: Any) -> None:
        self._descriptor, self._array = descriptor, array

    def component_descriptor(self) -> Any:
        return self._descriptor

    def as_arrow_array(self) -> Any:
        return self._array


@lru_cache(maxsize=256)
def _offsets(rows: int, series: int) -> Any:
    import pyarrow

    return pyarrow.array(np.arange(rows + 1, dtype=np.int32) * series)


def send_scalars(stream: Any, path: str, t_ns: np.ndarray, values: np.ndarray) -> None:
    """Log `values` `(rows, series)` [as named by the entity's style] at `t_ns` `(rows,)`."""
    import pyarrow

    if not len(t_ns):
        return
    flat = np.ascontiguousarray(values, np.float64).reshape(-1)
    array = pyarrow.ListArray.from_arrays(_offsets(len(t_ns), flat.size // len(t_ns)), pyarrow.array(flat))
    column = _Column(load_rerun().Scalars.descriptor_scalars(), array)
    stream.send_columns(path, indexes=[Times(t_ns)], columns=[column])


def send_states(stream: Any, path: str, t_ns: np.ndarray, states: list[str]) -> None:
    """Log transitions into named states; an empty name ends a state."""
    rr = load_rerun()
    if states:
        stream.send_columns(path, indexes=[Times(t_ns)], columns=rr.StateChange.columns(state=states))


def style_lines(
    stream: Any, path: str, names: list[str], colors: list[tuple[int, ...]], width: float = 1.2
) -> None:
    """Name and colour the series of an entity."""
    rr = load_rerun()
    stream.log(path, rr.SeriesLines(names=names, colors=colors, widths=[width] * len(names)), static=True)
