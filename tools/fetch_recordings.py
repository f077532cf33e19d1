"""Fetch the public recordings that the project is tested on: `python -m tools.fetch_recordings DIR`.

Each original comes from its public repository at a fixed commit and is converted to the project's format: the MEMS
IMU in a thermal chamber (tofupilot/examples), a car's CAN bus with a CANmod.gps (CSS-Electronics/api-examples), and
a car's CAN bus with its factory yaw rate (commaai/comma2k19); all MIT. Tests read them from ../shared/recordings.

What is checked: `css_gnss.dbc` by the sha256 of its original. The sha256 of the other originals was not known when
this was written: the converted results are checked instead (sha256 of every number, first, last and mean time), and
the originals' hashes are kept in DIR/originals/SHA256SUMS, by which later runs check them. Proven on real data are
the decoding of both CAN logs; the readers of the chamber's original, of MF4, of the phone's gyro and of the poses
follow their descriptions and are proven by that check at the first run only.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np

from rtcomp.atomic import write_atomically
from rtcomp.errors import RequestError, WorkError
from rtcomp.sources.candump import CandumpWriter
from tools.recordings import convert, sources
from tools.recordings.convert import Columns, Frames
from tools.recordings.digest import frames_digest, table_digest, time_marks
from tools.recordings.sources import Original

Fetch = Callable[[Original], Path]
SUMS = "SHA256SUMS"


class Store:
    """Originals in a folder, each fetched once and known by its sha256 from then on."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        lines = (folder / SUMS).read_text().splitlines() if (folder / SUMS).is_file() else []
        self.known = {name: value for value, name in (line.split(maxsplit=1) for line in lines)}

    def __call__(self, original: Original) -> Path:
        """The local copy of an original. Raises WorkError where it cannot be had or is not what it was."""
        import pooch

        expected = original.sha256 or self.known.get(original.name)
        reasons = []
        for url in original.urls:
            try:
                path = pooch.retrieve(url, expected, original.name, self.folder, progressbar=False)
            except (
                OSError,
                ValueError,
            ) as error:  # requests' errors are OSErrors; a wrong hash is a ValueError
                reasons.append(f"{url}: {str(error).splitlines()[0]}")
                continue
            self._keep(original.name, Path(path))
            return Path(path)
        raise WorkError(f"cannot fetch {original.name}: {'; '.join(reasons)}; is the network there?")

    def _keep(self, name: str, path: Path) -> None:
        with path.open("rb") as file:
            self.known[name] = hashlib.file_digest(file, "sha256").hexdigest()
        lines = "".join(f"{value}  {known}\n" for known, value in sorted(self.known.items()))
        write_atomically(self.folder / SUMS, lines.encode())


def write_table(columns: Columns, path: Path) -> None:
    """Check a table against what is known of it, and write it. Raises WorkError where it is another one."""
    import pyarrow as pa

    from training.table import write_gzipped_csv

    known = sources.TABLES[path.name]
    rounded = {
        name: np.round(values, digits)
        for (name, values), digits in zip(columns.items(), known.decimals, strict=True)
    }
    places = known.decimals[1 if "log" in columns else 0]
    same_times = np.allclose(time_marks(columns), known.times_s, rtol=0.0, atol=1.01 * 10.0**-places)
    if table_digest(rounded, known.decimals) != known.sha256 or not same_times:
        raise WorkError(
            f"{path.name}: converted, but not to the recording that is known; its original or its conversion changed"
        )
    write_gzipped_csv(pa.table(rounded), path)


def write_log(frames: Frames, path: Path) -> None:
    """The same for a CAN log."""
    if frames_digest(frames) != sources.LOGS[path.name]:
        raise WorkError(
            f"{path.name}: converted, but not to the log that is known; its original or its conversion changed"
        )
    with CandumpWriter(path) as writer:
        writer.append(frames)


def write_dbc(content: bytes, path: Path) -> None:
    """The same for a DBC file."""
    if hashlib.sha256(content).hexdigest() != sources.DBCS[path.name]:
        raise WorkError(f"{path.name}: not the DBC that is known; its original changed")
    write_atomically(path, content)


def chamber(fetch: Fetch, folder: Path) -> None:
    """The MEMS IMU through one cycle of a thermal chamber."""
    write_table(convert.chamber_table(fetch(sources.CHAMBER)), folder / "tofupilot_mems_chamber.csv.gz")


def css(fetch: Fetch, folder: Path) -> None:
    """The drive with a CANmod.gps: eleven MF4 logs."""
    dbc = fetch(sources.CSS_DBC)
    write_dbc(dbc.read_bytes(), folder / "css_gnss.dbc")
    pieces = [convert.log_frames(fetch(log)) for log in sources.CSS_LOGS]
    write_log(np.concatenate(pieces), folder / "css_vw_drive.log.gz")
    for name, columns in convert.css_tables(pieces, dbc).items():
        write_table(columns, folder / name)


def comma(fetch: Fetch, folder: Path) -> None:
    """A minute of a car with its factory yaw rate, a phone's gyro, and poses."""
    subset = convert.dbc_subset(fetch(sources.TOYOTA).read_text(encoding="utf-8"), sources.TOYOTA_IDS)
    write_dbc(subset.encode(), folder / "toyota_2017_subset.dbc")
    can = {field: _array(fetch(original)) for field, original in sources.COMMA_CAN.items()}
    frames = convert.comma_frames(can["t"], can["address"], can["data"], can["src"])
    write_log(frames, folder / "comma2k19_rav4_bus0.log.gz")
    t0 = float(can["t"][can["src"] == 0][0])
    tables = convert.comma_tables(frames, folder / "toyota_2017_subset.dbc", t0)
    gyro = {field: _array(fetch(original)) for field, original in sources.COMMA_GYRO.items()}
    pose = {field: _array(fetch(original)) for field, original in sources.COMMA_POSE.items()}
    tables["comma2k19_phone_gyro.csv.gz"] = convert.phone_gyro(gyro["t"], gyro["value"], t0)
    tables["comma2k19_pose_rate.csv.gz"] = convert.pose_rates(
        pose["frame_times"], pose["frame_orientations"], t0
    )
    for name, columns in tables.items():
        write_table(columns, folder / name)


def _array(path: Path) -> np.ndarray:
    return np.load(path, allow_pickle=False)


RECORDINGS = {"chamber": chamber, "css": css, "comma": comma}


@click.command(help=__doc__)
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option("--only", type=click.Choice(sorted(RECORDINGS)), multiple=True, help="Only these.")
def main(folder: Path, only: tuple[str, ...]) -> None:
    """Fetch, convert and check every recording."""
    failed = []
    try:
        (folder / "originals").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise click.UsageError(f"cannot make folder {folder}: {error.strerror}") from error
    for name in only or RECORDINGS:
        try:
            RECORDINGS[name](Store(folder / "originals"), folder)
            click.echo(f"{name}: fetched, converted, checked")
        except (WorkError, RequestError) as error:
            failed.append(name)
            click.echo(f"{name}: {error}", err=True)
    if failed:
        raise click.exceptions.Exit(1)


if __name__ == "__main__":
    main()
