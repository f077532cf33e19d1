"""Rows of numbers into rerun by columns: one call per entity and batch, Arrow arrays straight from numpy's."""

from functools import lru_cache
from typing import Any

import numpy as np

from rtcomp.view.rerun_sdk import TIMELINE, load_rerun


class Times:
    """A time column [ns UNIX], made once per batch and given with every entity."""

    def __init__(self, t_ns: np.ndarray) -> None:
        """`t_ns` `(rows,)`."""
        self._array = _owned(self._kind(), np.asarray(t_ns, np.int64))

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


def _owned(kind: Any, values: np.ndarray) -> Any:
    """`values` in Arrow's own memory: rerun's threads give that back without waiting for the interpreter's lock.

    `pyarrow.array(values)` looks for pandas types first, which takes ten times as long.
    """
    import pyarrow

    buffer = pyarrow.allocate_buffer(values.nbytes)
    np.frombuffer(buffer, values.dtype).reshape(values.shape)[...] = values
    return pyarrow.Array.from_buffers(kind, values.size, [None, buffer])


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
    offsets = _offsets(len(times), values.size // len(times))
    array = pyarrow.ListArray.from_arrays(offsets, _owned(double, np.asarray(values, np.float64)))
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
