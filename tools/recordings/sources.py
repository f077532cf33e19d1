"""Where the originals are, at which commit, and how the converted results are known again."""

from dataclasses import dataclass
from urllib.parse import quote

SEGMENT = "Example_1/b0c9d2329ad1606b|2018-08-02--08-34-47/40"
CSS = "CSS-Electronics/api-examples", "f7932bacb2969dec591508d15f89e8a898ca99c6"
COMMA = "commaai/comma2k19", "4c7f1a6e1957745beadc1def0e7225f559b09a2a"
DATASTORE = "examples/other/matlab-basics/LOG_datastore/3BA199E2"
PIECES = (
    *(f"00000164/{name}" for name in ("00000001-60FE3F04", "00000002-60FE415D", "00000003-60FE43B2")),
    *(f"00000164/{name}" for name in ("00000004-60FEB585", "00000005-60FEB5A8")),
    *(f"00000165/{name}" for name in ("00000001-60FEB68B", "00000002-60FEB8E3", "00000003-60FEBB3B")),
    *(f"00000165/{name}" for name in ("00000004-60FEBD93", "00000005-60FEBFEB", "00000006-60FFE42F")),
)


@dataclass(frozen=True)
class Original:
    """One file of a public repository at a commit; `paths` are where it may lie, `sha256` where it is known."""

    repository: str
    commit: str
    paths: tuple[str, ...]
    sha256: str | None = None

    @property
    def urls(self) -> list[str]:
        """Where to get it (large files are followed to where they are kept)."""
        return [f"https://github.com/{self.repository}/raw/{self.commit}/{quote(p)}" for p in self.paths]

    @property
    def name(self) -> str:
        """A flat name of its own for the copy that is kept."""
        return "__".join([self.repository.split("/")[1], *self.paths[0].replace("|", "_").split("/")[-3:]])


CHAMBER = Original(
    "tofupilot/examples",
    "fc190f7cd507ec6b53fba4c4368b1a2a0a8e5125",
    ("templates/imu_thermal_calibration/data/imu_raw_data.csv",),
)
CSS_LOGS = tuple(Original(*CSS, (f"{DATASTORE}/{piece}.MF4",)) for piece in PIECES)
CSS_DBC = Original(
    *CSS,
    ("examples/other/concatenate-mf4-by-period/dbc_files/gnss.dbc",),
    "57e73427d820266818d8d1796a4982f9a6c215a81f56ac003b3efef0c729571d",
)
COMMA_CAN = {
    field: Original(*COMMA, (f"{SEGMENT}/processed_log/CAN/raw_can/{field}",))
    for field in ("t", "address", "data", "src")
}
COMMA_GYRO = {f: Original(*COMMA, (f"{SEGMENT}/processed_log/IMU/gyro/{f}",)) for f in ("t", "value")}
COMMA_POSE = {
    f: Original(*COMMA, (f"{SEGMENT}/global_pose/{f}",)) for f in ("frame_times", "frame_orientations")
}
TOYOTA = Original(
    "commaai/opendbc",
    "7343a66d46213d5f73528afc6c6db713ebd88a9d",
    ("opendbc/dbc/generator/toyota/_toyota_2017.dbc", "generator/toyota/_toyota_2017.dbc"),
)
TOYOTA_IDS = (0x24, 0x25, 0xAA, 0xB4)


@dataclass(frozen=True)
class Table:
    """A converted table: decimals per column, first, last and mean time, and the sha256 of all other numbers."""

    decimals: tuple[int, ...]
    times_s: tuple[float, float, float]
    sha256: str


TABLES = {
    "tofupilot_mems_chamber.csv.gz": Table(
        (4, 7, 7, 7, 5, 6, 6, 6),
        (0.0, 4244.8795, 2121.852486),
        "93474ee7bb680df8e49a94674d17ab2d05de1fc4dd8f446803d6f7fb0c243941",
    ),
    "css_vw_imu100hz.csv.gz": Table(
        (0, 4, 2, 2, 2),
        (0.0, 33590.0355, 18035.746291),
        "53eb982b49b08e65e796de52b17c5ae4329d3da97f6a9ec74b4f9425f1c8b1f2",
    ),
    "css_vw_gnss1hz.csv.gz": Table(
        (0, 3, 0, 1, 1, 1, 1, 4),
        (-1.142, 33589.989, 18028.878508),
        "40a39111fdfafabf04efe0c698987df2dfb021729c5af1822e7d0807743a5455",
    ),
    "css_vw_coolant.csv.gz": Table(
        (0, 5, 0),
        (1627274455.0444, 1627308061.26845, 1627292486.266283),
        "cbf0ba4347fcf16dd7f749e7a3332c8388c9f0501af5cbff68337bb5098417dd",
    ),
    "comma2k19_rav4_can_yaw.csv.gz": Table(
        (6, 3),
        (3.9e-05, 59.987291, 29.993565),
        "22091980109e1ae744aee718e297665431618e34a01efae4b88e8f91bc556f23",
    ),
    "comma2k19_rav4_wheels.csv.gz": Table(
        (6, 2, 2, 2, 2),
        (0.004572, 59.992687, 29.998635),
        "6363d214bf5b504fab3914616103728f54e3553066e64ea609144d516c3f8140",
    ),
    "comma2k19_phone_gyro.csv.gz": Table(
        (6, 5, 5, 5),
        (-0.004896, 59.986991, 29.991001),
        "dd70cba17372b308adc29cc1b1252ad56dafc041cf59afbb41db4ff7c90c8940",
    ),
    "comma2k19_pose_rate.csv.gz": Table(
        (6, 5, 5, 5),
        (-0.012428, 59.88674, 29.937149),
        "07f957f9e44e2099e1f9c90abecc3fd2ecc86ef85733e4a4e21eddda61c872e1",
    ),
}
LOGS = {
    "css_vw_drive.log.gz": "45539ccc989f180ee2794d1c16ee822edac0c329858a6b6ef777a6613ecf04fb",
    "comma2k19_rav4_bus0.log.gz": "4c69495646d5771fa59080d07527007f9d24fbd973434667bdd3aac014d0c1d4",
}
DBCS = {
    "css_gnss.dbc": "57e73427d820266818d8d1796a4982f9a6c215a81f56ac003b3efef0c729571d",
    "toyota_2017_subset.dbc": "732bd5943c1db64ae685a2b13533c29bb284d5cf322ad3a687dcaec8e61c21c8",
}
