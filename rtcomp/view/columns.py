"""Rows of numbers into rerun by columns: one call per entity and batch, Arrow arrays laid over numpy's memory."""

from functools import lru_cache
from typing import Any

import numpy as np

from rtcomp.view.rerun_sdk import TIMELINE, load_rerun


class Times:
    """A time column [ns UNIX], made once per batch and given with every entity."""

    def __init__(self, t_ns: np.ndarray) -> None:
        """`t_ns` `(rows,)`."""
        self._array = _laid_over(self._kind(), np.ascontiguousarray(t_ns, np.int64))

    @staticmethod
    def _kind() -> Any:
        import pyarrow

        return pyarrow.timestamp("ns")

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._array)

    def timeline_name(self) -> str:
        """The timeline's name."""
        return TIMELINE

    def as_arrow_array(self) -> Any:
        """The times."""
        return self._array


class Elapsed(Times):
    """A time column [ns since the start of a recording]."""

    @staticmethod
    def _kind() -> Any:
        import pyarrow

        return pyarrow.duration("ns")


class _Column:
    """A component column whose Arrow array is there already (rerun's own builder costs four times the logging)."""

    def __init__(self, descriptor: Any, array: Any) -> None:
        self._descriptor, self._array = descriptor, array

    def component_descriptor(self) -> Any:
        return self._descriptor

    def as_arrow_array(self) -> Any:
        return self._array


def _laid_over(kind: Any, values: np.ndarray) -> Any:
    """An Arrow array on the memory of contiguous `values`, which nobody changes any more.

    `pyarrow.array(values)` looks for pandas types first, which takes ten times as long.
    """
    import pyarrow

    return pyarrow.Array.from_buffers(kind, values.size, [None, pyarrow.py_buffer(values)])


@lru_cache(maxsize=256)
def _offsets(rows: int, series: int) -> Any:
    import pyarrow

    return pyarrow.array(np.arange(rows + 1, dtype=np.int32) * series)


@lru_cache(maxsize=1)
def _scalars() -> tuple[Any, Any]:
    import pyarrow

    return load_rerun().Scalars.descriptor_scalars(), pyarrow.float64()


def side_by_side(*columns: np.ndarray) -> np.ndarray:
    """Columns `(rows,)` of any kind as one array `(rows, columns)` of doubles."""
    table = np.empty((len(columns[0]), len(columns)))
    for k, column in enumerate(columns):
        table[:, k] = column
    return table


def send_scalars(stream: Any, path: str, times: Times, values: np.ndarray) -> None:
    """Log `values` `(rows, series)` [as named by the entity's style]."""
    import pyarrow

    if not len(times):
        return
    descriptor, double = _scalars()
    flat = np.ascontiguousarray(values, np.float64).reshape(-1)
    offsets = _offsets(len(times), flat.size // len(times))
    array = pyarrow.ListArray.from_arrays(offsets, _laid_over(double, flat))
    stream.send_columns(path, indexes=[times], columns=[_Column(descriptor, array)])


def send_states(stream: Any, path: str, times: Times, states: list[str]) -> None:
    """Log transitions into named states; an empty name ends a state."""
    rr = load_rerun()
    if states:
        stream.send_columns(path, indexes=[times], columns=rr.StateChange.columns(state=states))


def style_lines(
    stream: Any, path: str, names: list[str], colors: list[tuple[int, ...]], width: float = 1.2
) -> None:
    """Name and colour the series of an entity."""
    rr = load_rerun()
    stream.log(path, rr.SeriesLines(names=names, colors=colors, widths=[width] * len(names)), static=True)
