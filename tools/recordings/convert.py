"""From public originals to the project's format: tables in °/s, °C and s, and candump logs.

Every function takes what an original file holds and gives columns (name → array of shape `(n,)`) or frames.
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtcomp.dbc import load_dbc
from rtcomp.frames import FRAME
from rtcomp.sources.logs import read_log

Columns = dict[str, np.ndarray]
Frames = NDArray[np.void]
IMU_ID, ATTITUDE_ID, SPEED_ID, OBD_ID = 0x009, 0x005, 0x007, 0x7E8
YAW_ID, WHEELS_ID = 0x024, 0x0AA
COOLANT = (0x41, 0x05)  # OBD-II mode 1, PID 5: °C above −40 in the byte behind it
"""The CAN ids that are decoded."""


def chamber_table(path: Path) -> Columns:
    """The MEMS IMU in a chamber: tab-separated, time in µs, rates in rad/s, accelerations in m/s²."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file, delimiter="\t")
        names = list(rows.fieldnames or ())
        values = {name: [] for name in names}
        for row in rows:
            for name in names:
                values[name].append(row[name])
    [time] = [name for name in names if "time" in name.lower()]
    t = np.array(values[time], float)
    columns = {"t_s": (t - t[0]) * 1e-6}
    columns |= {f"gyro_{a}_dps": np.degrees(np.array(values[f"imu.gyro.{a}"], float)) for a in "xyz"}
    columns["temp_C"] = np.array(values["imu.temperature"], float)
    return columns | {f"acc_{a}_mps2": np.array(values[f"imu.acc.{a}"], float) for a in "xyz"}


def log_frames(path: Path) -> Frames:
    """All frames of a log of any format in the order of their times, to the whole µs (MF4 holds float seconds)."""
    frames = np.concatenate([np.empty(0, FRAME), *read_log(path)])
    frames["t_ns"] = (frames["t_ns"] + 500) // 1000 * 1000
    return frames[np.argsort(frames["t_ns"], kind="stable")]


def css_tables(pieces: Sequence[Frames], dbc: Path) -> dict[str, Columns]:
    """The decoded tables of the drive with the CANmod.gps, one row per frame, `log` the number of its piece.

    Times count from the first IMU frame of the first piece; the coolant's are UNIX seconds.
    """
    signals = load_dbc(dbc)
    imu, gnss, coolant = [], [], []
    start = int(pieces[0]["t_ns"][pieces[0]["can_id"] == IMU_ID][0])
    for number, frames in enumerate(pieces):
        imu.append(_css_imu(frames, signals, number, start))
        gnss.append(_css_gnss(frames, signals, number, start))
        coolant.append(_css_coolant(frames, number))
    return {
        "css_vw_imu100hz.csv.gz": _stacked(imu),
        "css_vw_gnss1hz.csv.gz": _stacked(gnss),
        "css_vw_coolant.csv.gz": _stacked(coolant),
    }


def _css_imu(frames: Frames, signals: Any, number: int, start: int) -> Columns:
    names = {f"AngularRate{a}": f"gyro_{a.lower()}_dps" for a in "XYZ"}
    t_ns, values = decoded(frames, signals, IMU_ID, names)
    return {"log": np.full(len(t_ns), float(number)), "t_s": (t_ns - start) * 1e-9, **values}


def _css_gnss(frames: Frames, signals: Any, number: int, start: int) -> Columns:
    """Attitude, with the speed interpolated to its times."""
    names = {
        "AttitudeValid": "att_valid",
        "Roll": "roll_deg",
        "Pitch": "pitch_deg",
        "Heading": "heading_deg",
        "HeadingAccuracy": "heading_acc_deg",
    }
    t_ns, attitude = decoded(frames, signals, ATTITUDE_ID, names)
    speed_ns, speed = decoded(frames, signals, SPEED_ID, {"Speed": "speed_mps"})
    columns = {"log": np.full(len(t_ns), float(number)), "t_s": (t_ns - start) * 1e-9, **attitude}
    return columns | {"speed_mps": np.interp(t_ns - start, speed_ns - start, speed["speed_mps"])}


def _css_coolant(frames: Frames, number: int) -> Columns:
    data = frames["data"]
    rows = (frames["can_id"] == OBD_ID) & (data[:, 1] == COOLANT[0]) & (data[:, 2] == COOLANT[1])
    return {
        "log": np.full(int(rows.sum()), float(number)),
        "t": frames["t_ns"][rows] * 1e-9,
        "coolant_C": data[rows, 3].astype(float) - 40.0,
    }


def _stacked(parts: Sequence[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def decoded(
    frames: Frames, signals: Any, can_id: int, names: dict[str, str]
) -> tuple[NDArray[np.int64], Columns]:
    """Times [ns] and the named signals (DBC name → column) of every frame of one id, by cantools."""
    message = signals.get_message_by_frame_id(can_id)
    rows = frames[frames["can_id"] == can_id]
    values = np.empty((len(rows), len(names)))
    for target, data in zip(values, rows["data"][:, : message.length], strict=True):
        found = message.decode(data.tobytes(), decode_choices=False)
        target[:] = [found[name] for name in names]
    return rows["t_ns"], dict(zip(names.values(), values.T, strict=True))


def comma_frames(t_s: np.ndarray, address: np.ndarray, data: np.ndarray, source: np.ndarray) -> Frames:
    """Bus 0 of a comma2k19 segment; numpy dropped the zeros at the end of payloads, so all are padded to 8 bytes."""
    rows = np.flatnonzero(source == 0)
    frames = np.zeros(len(rows), FRAME)
    frames["t_ns"] = np.rint(t_s[rows] * 1e9).astype(np.int64)
    frames["can_id"], frames["length"] = address[rows], 8
    for target, payload in zip(frames["data"], data[rows], strict=True):
        raw = bytes(payload)[:8]
        target[: len(raw)] = np.frombuffer(raw, np.uint8)
    return frames


def comma_tables(frames: Frames, dbc: Path, t0_s: float) -> dict[str, Columns]:
    """Factory yaw rate and wheel speeds, times from the segment's first frame at `t0_s`."""
    signals = load_dbc(dbc)
    yaw_ns, yaw = decoded(frames, signals, YAW_ID, {"YAW_RATE": "can_yaw_dps"})
    corners = ("FR", "FL", "RR", "RL")
    wheel_ns, wheels = decoded(
        frames, signals, WHEELS_ID, {f"WHEEL_SPEED_{c}": f"wheel_{c}_kph" for c in corners}
    )
    return {
        "comma2k19_rav4_can_yaw.csv.gz": {"t_s": yaw_ns * 1e-9 - t0_s, **yaw},
        "comma2k19_rav4_wheels.csv.gz": {"t_s": wheel_ns * 1e-9 - t0_s, **wheels},
    }


def phone_gyro(t_s: np.ndarray, rates_rad_s: np.ndarray, t0_s: float) -> Columns:
    """The phone's gyro, rates of shape (n, 3) in rad/s."""
    return {"t_s": t_s - t0_s} | {
        f"phone_gyro_{a}_dps": np.degrees(rates_rad_s[:, k]) for k, a in enumerate("xyz")
    }


def pose_rates(t_s: np.ndarray, orientations: np.ndarray, t0_s: float) -> Columns:
    """Angular rate of the camera between frames, in its own axes (forward, right, down), half way in time.

    `orientations` are Hamilton quaternions (w, x, y, z) from the Earth to the camera, shape (n, 4).
    """
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(orientations[:, [1, 2, 3, 0]])
    between = (turned[:-1].inv() * turned[1:]).as_rotvec() / np.diff(t_s)[:, None]
    middle = 0.5 * (t_s[1:] + t_s[:-1]) - t0_s
    return {"t_s": middle} | {f"pose_w{a}_dps": np.degrees(between[:, k]) for k, a in enumerate("xyz")}


def dbc_subset(text: str, ids: Sequence[int]) -> str:
    """Only these messages of a DBC, under the shortest header."""
    blocks, wanted = [], [str(i) for i in ids]
    keeping = False
    for line in text.splitlines():
        if line.startswith("BO_ "):
            keeping = line.split()[1] in wanted
            blocks += [[]] if keeping else []
        elif not line.startswith(" SG_"):
            keeping = False
        if keeping:
            blocks[-1].append(line.rstrip())
    head = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: XXX\n\n'
    return head + "".join("\n".join(block) + "\n\n" for block in blocks)
