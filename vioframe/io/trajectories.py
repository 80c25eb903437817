"""Trajectory files: TUM and EuRoC csv, plain or gzip'd, with stamps kept exact to the nanosecond.

    TUM     t x y z qx qy qz qw                    seconds; separated by blanks
    EuRoC   t,x,y,z,qw,qx,qy,qz[,velocity[,biases]]  nanoseconds; 8, 11 or 17 columns separated by commas

A float64 of seconds since 1970 resolves 240 ns, so stamps are read digit by digit and written as integers.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal, DecimalException
from io import BytesIO
from math import hypot, isfinite
from pathlib import Path
from typing import Self

import numpy as np

from vioframe.errors import TrajectoryError, shortened
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.types import NS_PER_S, Float, Int

_GZIP_MAGIC = b"\x1f\x8b"
_MOTION_CAPTURE = re.compile(r"vicon|leica", re.IGNORECASE)
_EUROC_COLUMNS, _TUM_COLUMNS = (8, 11, 17), (8,)
_EUROC_HEADING = (
    "#timestamp",
    *(f" p_RS_R_{axis} [m]" for axis in "xyz"),
    *(f" q_RS_{part} []" for part in "wxyz"),
    *(f" v_RS_R_{axis} [m s^-1]" for axis in "xyz"),
    *(f" b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"),
    *(f" b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"),
)
_QUAT_NORM_TOLERANCE = 0.01
_INT64_MAX = 2**63 - 1
# Some three million poses; a few hundred kilobytes can be made to unpack to more than any memory holds.
_MOST_BYTES = 2**29


@dataclass(frozen=True, eq=False)
class TrueTrajectory(Trajectory):
    """A trajectory that knows velocity and biases too, as EuRoC's ground truth does, and keeps numbers as given.

    ``values`` (N, 7, 10 or 16) are ``p_WB`` and the quaternion wxyz (of any norm), then ``v_WB`` m/s, then
    ``bias_gyro_B`` rad/s and ``bias_accel_B`` m/s^2: the columns of EuRoC's file behind the stamp.
    """

    values: Float = field(kw_only=True)

    @classmethod
    def of(cls, t_ns: Int, values: Float) -> Self:
        """From stamps (N,) and ``values``."""
        poses = Trajectory.from_quat_xyzw(t_ns, values[:, :3], values[:, [4, 5, 6, 3]])
        return cls(poses.t_ns, poses.R_WB, poses.p_WB, values=values)


def true_values(trajectory: Trajectory) -> Float:
    """The ``values`` of a :class:`TrueTrajectory`, (N, 7) of the poses where it is none."""
    if isinstance(trajectory, TrueTrajectory):
        return trajectory.values
    return np.hstack([trajectory.p_WB, trajectory.quat_xyzw[:, [3, 0, 1, 2]]])


def load_trajectory(
    path: str | Path, *, complete_lines_only: bool = False, keep_first_of_repeats: bool = False
) -> Trajectory:
    """Read a TUM or EuRoC file; which one is told from its contents. EuRoC's is a :class:`TrueTrajectory`.

    Of a folder it is the ground truth that is found in it.

    ``complete_lines_only`` ignores a last line without its line end, as an interrupted run leaves behind;
    ``keep_first_of_repeats`` drops lines that repeat the stamp of the line before, else an error. Raises
    :class:`TrajectoryError`, with the line, for anything malformed, and for raw Vicon or Leica recordings: those are
    neither aligned in time nor (Leica) poses, so an evaluation against them would be wrong without looking wrong.
    """
    path = _truth_in(Path(path)) if Path(path).is_dir() else Path(path)
    text = _read_text(path)
    if complete_lines_only:
        text = text[: text.rfind("\n") + 1]
    heading, commas, lines = _split(text)
    if not lines:
        raise TrajectoryError(f"{path.name}: holds no poses; give a TUM or EuRoC trajectory")
    first, columns = lines[0][0], len(lines[0][1])
    _refuse_motion_capture(path, heading, commas, columns)
    if columns not in (_EUROC_COLUMNS if commas else _TUM_COLUMNS):
        layouts = "neither TUM (8, blanks) nor EuRoC (8, 11 or 17, commas)"
        raise TrajectoryError(f"{path.name}, line {first}: {columns} columns are {layouts}")
    t_ns: list[int] = []
    rows: list[list[float]] = []
    before = first, ""
    for number, fields in lines:
        try:
            if len(fields) != columns:
                raise ValueError(f"{len(fields)} columns where line {first} has {columns}")
            if keep_first_of_repeats and fields[0] == before[1]:
                continue
            stamp_ns, row = _pose(fields, is_euroc=commas)
            if t_ns and stamp_ns <= t_ns[-1]:
                kind = "repeats" if stamp_ns == t_ns[-1] else "is before"
                raise ValueError(f"the stamp {fields[0]} {kind} that of line {before[0]}; sort or drop such lines")
        except ValueError as problem:
            raise TrajectoryError(f"{path.name}, line {number}: {shortened(problem)}") from None
        t_ns.append(stamp_ns)
        rows.append(row)
        before = number, fields[0]
    stamps, values = np.array(t_ns, dtype=np.int64), np.array(rows)
    if commas:
        return TrueTrajectory.of(stamps, values)
    return Trajectory.from_quat_xyzw(stamps, values[:, :3], values[:, 3:7])


def tum_line(t_ns: int, R_WB: Float, p_WB: Float) -> str:
    """One line of a TUM file, with its line end: exact nanoseconds, position to 1 nm, quaternion to 1e-12."""
    return _tum_line(int(t_ns), p_WB, so3.to_quat_xyzw(R_WB))


def write_tum(trajectory: Trajectory, path: str | Path) -> None:
    """Write ``trajectory`` as a TUM file, gzip'd where the name ends in ``.gz``."""
    path = Path(path)
    poses = zip(trajectory.t_ns.tolist(), trajectory.p_WB, trajectory.quat_xyzw, strict=True)
    text = "# timestamp tx ty tz qx qy qz qw\n" + "".join(_tum_line(*pose) for pose in poses)
    # Without a time of its own in the gzip header, equal trajectories give equal bytes.
    data = gzip.compress(text.encode(), mtime=0) if path.suffix == ".gz" else text.encode()
    path.write_bytes(data)


def write_euroc(trajectory: Trajectory, path: str | Path) -> None:
    """Write ``trajectory`` as a EuRoC csv of 17, 11 or 8 columns, as many as it knows; numbers read back equal."""
    values = true_values(trajectory)
    heading = ",".join(_EUROC_HEADING[: 1 + values.shape[1]])
    if values.shape[1] == 7:
        # Poses alone under EuRoC's names are its raw motion capture, which is refused as a truth.
        heading = heading.replace("RS_R", "WB")
    rows = zip(trajectory.t_ns.tolist(), values.tolist(), strict=True)
    lines = (",".join([str(t_ns), *map(repr, row)]) + "\n" for t_ns, row in rows)
    Path(path).write_text(heading + "\n" + "".join(lines), encoding="utf-8")


def _tum_line(t_ns: int, p_WB: Float, quat_xyzw: Float) -> str:
    seconds, nanoseconds = divmod(abs(t_ns), NS_PER_S)
    stamp = f"{'-' if t_ns < 0 else ''}{seconds}.{nanoseconds:09d}"
    position = " ".join(f"{x:.9f}" for x in p_WB)
    return f"{stamp} {position} " + " ".join(f"{q:.12f}" for q in quat_xyzw) + "\n"


def _truth_in(folder: Path) -> Path:
    """The file of the ground truth in a sequence in ASL layout, in its folder of it, or in a run folder."""
    estimate = Path("state_groundtruth_estimate0") / "data.csv"
    usual = [folder / "mav0" / estimate, folder / estimate, folder / "ground_truth.tum"]
    usual += [folder / estimate.name] * (folder.resolve().name == estimate.parent.name)
    if found := next((file for file in usual if file.is_file()), None):
        return found
    files = sorted(file.name for file in folder.iterdir() if file.suffix in (".tum", ".csv", ".txt"))
    hint = f"; name one of its files: {', '.join(files[:5])}" if files else ""
    raise TrajectoryError(f"{folder}: a folder without {estimate} or ground_truth.tum{hint}")


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
        if data.startswith(_GZIP_MAGIC):
            with gzip.open(BytesIO(data)) as unpacked:
                data = unpacked.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise TrajectoryError(f"{path}: holds more than {_MOST_BYTES >> 20} MiB; no trajectory is so long")
        return data.decode("utf-8-sig")
    except FileNotFoundError:
        raise TrajectoryError(f"{path}: no such trajectory file; check the path") from None
    except UnicodeDecodeError:
        raise TrajectoryError(f"{path}: not a text file; give a TUM or EuRoC trajectory") from None
    except (OSError, EOFError, zlib.error) as error:
        raise TrajectoryError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}); give a TUM or EuRoC trajectory"
        ) from None


def _split(text: str) -> tuple[str, bool, list[tuple[int, list[str]]]]:
    """The heading; whether columns are separated by commas; and the fields of each line, with its number from 1."""
    heading, commas = "", False
    lines: list[tuple[int, list[str]]] = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if line.startswith(("#", "%")) or (not lines and line[:1].isalpha()):
            heading = heading or line
        elif line:
            commas = "," in line if not lines else commas
            # VINS-Mono ends each line of its csv with a comma.
            lines.append((number, line.rstrip(",").split(",") if commas else line.split()))
    return heading, commas, lines


def _refuse_motion_capture(path: Path, heading: str, commas: bool, columns: int) -> None:
    # EuRoC's vicon0/data.csv has the column names of its ground truth, but stops after the quaternion.
    vicon_columns = commas and columns == 8 and "p_RS_R_x" in heading
    if columns == 4 or vicon_columns or _MOTION_CAPTURE.search(f"{path.parent.name}/{path.name}"):
        raise TrajectoryError(
            f"{path}: raw Vicon or Leica measurements are not a body trajectory in the cameras' clock; "
            "use state_groundtruth_estimate0/data.csv of the ASL folder"
        )


def _pose(fields: Sequence[str], is_euroc: bool) -> tuple[int, list[float]]:
    """Stamp, ns, and the numbers behind it; raises :class:`ValueError` where the first seven are no pose."""
    stamp = fields[0]
    try:
        t_ns = Decimal(stamp) * (1 if is_euroc else NS_PER_S)
    except DecimalException:  # no number, or one of more digits than it can have
        raise ValueError(f"the stamp {stamp!r} is not a number that a time can be") from None
    if not t_ns.is_finite() or abs(t_ns) > _INT64_MAX:
        hint = " ns" if is_euroc else " seconds; are the stamps nanoseconds? separate EuRoC columns by commas"
        raise ValueError(f"the stamp {stamp} is not a time in{hint}")
    if is_euroc and t_ns != t_ns.to_integral_value():
        raise ValueError(f"the stamp {stamp} is not integer nanoseconds; TUM files are separated by blanks")
    values = [_float_or_nan(field) for field in fields[1:]]
    if not all(map(isfinite, values[:7])):
        raise ValueError(f"the pose is not finite: {' '.join(fields[1:8])}")
    if abs(hypot(*values[3:7]) - 1.0) > _QUAT_NORM_TOLERANCE:
        raise ValueError("the quaternion is not of unit norm; are the columns in order?")
    return int(t_ns.to_integral_value()), values


def _float_or_nan(field: str) -> float:
    try:
        return float(field)
    except ValueError:
        return float("nan")
