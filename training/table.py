"""Recordings as tables: one dataclass, read from CSV, Parquet or a CAN log, written to CSV or Parquet."""

import gzip
import hashlib
import io
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtcomp.atomic import write_atomically
from rtcomp.errors import RequestError

if TYPE_CHECKING:
    import pyarrow as pa

logger = logging.getLogger(__name__)

COLUMNS = (
    "t_s",
    "rate_dps",
    "temp_degC",
    "ref_rate_dps",
    "sim_rate_dps",
    "coil_temp_degC",
    "heading_deg",
    "speed_mps",
    "accel_lat_mps2",
    "vibration_rms_mps2",
    "counter",
)
"""Every column a recording may have."""
TABLES = (".csv", ".csv.gz", ".parquet")


@dataclass(frozen=True)
class Recording:
    """Columns of equal length, float64, by the names in `COLUMNS`; `t_s` is absent for rate-table averages."""

    name: str
    columns: dict[str, np.ndarray]
    path: Path | None = None
    sha256: str | None = None
    ignored: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, column: str) -> np.ndarray:
        """A column by its name."""
        return self.columns[column]

    def __contains__(self, column: str) -> bool:
        """Whether the recording has this column."""
        return column in self.columns

    def get(self, column: str) -> np.ndarray | None:
        """A column, or None where the recording has none."""
        return self.columns.get(column)

    def take(self, rows: np.ndarray) -> "Recording":
        """The recording with only these rows (a mask or indices)."""
        kept = {name: values[rows] for name, values in self.columns.items()}
        return Recording(self.name, kept, self.path, self.sha256, self.ignored)


def parse_columns(text: str | None) -> dict[str, str]:
    """Read `rate_dps=gyro_x_dps,temp_degC=temp_C` into {our name: name in the file}.

    Raises RequestError for what is not of that form or names an unknown column.
    """
    pairs = {}
    for item in filter(None, (text or "").split(",")):
        ours, equals, theirs = (part.strip() for part in item.partition("="))
        if not equals or ours not in COLUMNS or not theirs:
            raise RequestError(
                f"--columns: got {item!r}, wanted OURS=THEIRS with OURS one of {', '.join(COLUMNS)}"
            )
        pairs[ours] = theirs
    return pairs


def read_recording(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    dbc: str | Path | None = None,
    signal_map: str | Path | None = None,
    channel: str | None = None,
    require: Sequence[str] = ("rate_dps",),
) -> Recording:
    """Read a table (CSV, gzipped CSV, Parquet) or, with a signal map, a CAN log.

    Args:
        path: the file.
        columns: {our name: name in the file} for tables that use other names.
        dbc: overrides the map's DBC file.
        signal_map: name or file of the map that says which signals of a log are rate and temperature.
        channel: which of the map's channels, when it has several.
        require: columns without which the recording is of no use to the caller.

    Raises:
        RequestError: a missing or broken file, missing columns, no rows, text where numbers belong.
    """
    path = Path(path)
    if not path.is_file():
        raise RequestError(f"no such recording: {path}; give a CSV, a Parquet file or a CAN log")
    if path.name.lower().endswith(TABLES):
        found = _read_table(path, dict(columns or {}))
    elif signal_map is None:
        raise RequestError(
            f"{path}: taken for a CAN log by its name; give --map (and --dbc), or a {TABLES} table"
        )
    else:
        from training.can_log import read_can_log

        found = read_can_log(path, signal_map, dbc, channel)
    missing = [name for name in require if name not in found]
    if missing:
        raise RequestError(
            f"{path}: no column {', '.join(missing)}; rename with --columns {missing[0]}=NAME_IN_FILE"
        )
    known = {name: found[name] for name in COLUMNS if name in found}
    ignored = tuple(name for name in found if name not in COLUMNS)
    if not known or not len(next(iter(known.values()))):
        raise RequestError(f"{path}: no rows; a recording needs at least one")
    if ignored:
        logger.info("%s: columns not used: %s", path, ", ".join(ignored))
    return Recording(recording_name(path), known, path, _sha256(path), ignored)


def recording_name(path: Path) -> str:
    """A file's name without the endings that say what kind of file it is."""
    name = path.name.removesuffix(".gz")
    return Path(name).stem or name


def _read_table(path: Path, columns: dict[str, str]) -> dict[str, np.ndarray]:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    try:
        if path.suffix == ".parquet":
            table = pyarrow.parquet.read_table(path)
        else:
            options = pyarrow.csv.ConvertOptions(
                strings_can_be_null=True, null_values=["", "nan", "NaN", "NA", "null"]
            )
            table = pyarrow.csv.read_csv(path, convert_options=options)
    except (pa.ArrowInvalid, OSError, EOFError, gzip.BadGzipFile) as error:
        raise RequestError(f"{path}: not a readable table: {str(error).splitlines()[0]}") from error
    try:
        names: list[str] = list(table.column_names)
    except UnicodeDecodeError as error:
        raise RequestError(f"{path}: the header is not UTF-8 text: {error.reason}") from error
    if len(set(names)) != len(names):
        raise RequestError(f"{path}: a column name stands twice in the header {names}; make them distinct")
    absent = [theirs for theirs in columns.values() if theirs not in names]
    if absent:
        raise RequestError(f"{path}: no column {absent[0]!r} as --columns says; it has {', '.join(names)}")
    renamed = {theirs: ours for ours, theirs in columns.items()}
    return {
        renamed.get(name, name): _numbers(path, name, table[name])
        for name in names
        if renamed.get(name, name) in COLUMNS
    } | {name: np.empty(0) for name in names if renamed.get(name, name) not in COLUMNS}


def _numbers(path: Path, name: str, column: object) -> np.ndarray:
    import pyarrow as pa
    import pyarrow.compute

    try:
        floats = pyarrow.compute.cast(column, pa.float64())  # type: ignore[attr-defined]
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise RequestError(f"{path}: column {name} holds something that is not a number: {reason}") from error
    return np.array(floats.to_numpy(zero_copy_only=False), np.float64)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write a table: .csv, .csv.gz or .parquet by the name's ending; whole or not at all.

    Raises RequestError for another ending or a folder that cannot be written to.
    """
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    path = Path(path)
    if not path.name.lower().endswith(TABLES):
        raise RequestError(f"cannot write {path}: a recording's name ends in {' or '.join(TABLES)}")
    table = pa.table({name: recording.columns[name] for name in COLUMNS if name in recording.columns})
    if path.suffix == ".gz":
        write_gzipped_csv(table, path)
        return
    sink = pa.BufferOutputStream()
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(table, sink)
    else:
        pyarrow.csv.write_csv(table, sink)
    write_atomically(path, sink.getvalue().to_pybytes())


def write_gzipped_csv(table: "pa.Table", path: Path) -> None:
    """Write an Arrow table as a gzipped CSV, the same bytes for the same table; whole or not at all."""
    import pyarrow.csv

    sink = io.BytesIO()
    with gzip.GzipFile(fileobj=sink, mode="wb", compresslevel=6, mtime=0) as packed:
        pyarrow.csv.write_csv(table, packed)
    write_atomically(path, sink.getvalue())
