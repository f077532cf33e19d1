"""Recordings of a command line, read and checked."""

from collections.abc import Sequence
from pathlib import Path

from training.inputs import Checked, check, check_units
from training.table import parse_columns, read_recording


def load(
    paths: Sequence[Path],
    columns: str | None = None,
    static: bool = False,
    drop_nan: bool = False,
    signal_map: str | None = None,
    dbc: str | None = None,
    channel: str | None = None,
) -> list[Checked]:
    """Read and check every recording. Raises RequestError naming the first that is of no use."""
    renamed = parse_columns(columns)
    check_units(renamed)
    return [
        check(read_recording(path, renamed, dbc, signal_map, channel, require=()), static, drop_nan)
        for path in paths
    ]
