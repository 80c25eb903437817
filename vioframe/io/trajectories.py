"""Trajectory files: TUM and EuRoC csv, plain or gzip'd, with stamps kept exact to the nanosecond.

    TUM     t x y z qx qy qz qw                    seconds; separated by blanks
    EuRoC   t,x,y,z,qw,qx,qy,qz[,velocity[,biases]]  nanoseconds; 8, 11 or 17 columns separated by commas

A float64 of seconds since 1970 resolves 240 ns, so stamps are read digit by digit and written as integers.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Self

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.types import NS_PER_S, Float, Int

_GZIP_MAGIC = b"\x1f\x8b"
_MOTION_CAPTURE = re.compile(r"vicon|leica", re.IGNORECASE)
_EUROC_COLUMNS = (8, 11, 17)
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


@dataclass(frozen=True)
class _Table:
    """The numeric rows of a text file: fields as text, with the line (counted from 1) that each came from."""

    name: str
    header: str
    comma_separated: bool
    lines: list[int]
    rows: list[list[str]]

    def error(self, row: int, problem: str) -> TrajectoryError:
        return TrajectoryError(f"{self.name}, line {self.lines[row]}: {problem}")


def load_trajectory(
    path: str | Path, *, complete_lines_only: bool = False, keep_first_of_repeats: bool = False
) -> Trajectory:
    """Read a TUM or EuRoC file; which one is told from its contents. EuRoC's is a :class:`TrueTrajectory`.

    ``complete_lines_only`` ignores a last line without its line end, as an interrupted run leaves behind;
    ``keep_first_of_repeats`` drops lines that repeat the stamp of the line before, else an error. Raises
    :class:`TrajectoryError`, with the line, for anything malformed, and for raw Vicon or Leica recordings: those are
    neither aligned in time nor (Leica) poses, so an evaluation against them would be wrong without looking wrong.
    """
    path = Path(path)
    text = _read_text(path)
    if complete_lines_only:
        text = text[: text.rfind("\n") + 1]
    table = _split(path.name, text, keep_first_of_repeats)
    _refuse_motion_capture(path, table)
    columns = len(table.rows[0])
    if table.comma_separated and columns in _EUROC_COLUMNS:
        unit, quat_columns = 1, [5, 6, 7, 4]
    elif not table.comma_separated and columns == 8:
        unit, quat_columns = NS_PER_S, [4, 5, 6, 7]
    else:
        raise table.error(0, f"{columns} columns are neither TUM (8, blanks) nor EuRoC (8, 11 or 17, commas)")
    t_ns = _stamps(table, unit)
    values = _values(table)
    _check_order(table, t_ns)
    quat = values[:, quat_columns]
    off = np.abs(np.linalg.norm(quat, axis=1) - 1.0) > _QUAT_NORM_TOLERANCE
    if off.any():
        raise table.error(int(np.argmax(off)), "the quaternion is not of unit norm; are the columns in order?")
    if unit == 1:
        return TrueTrajectory.of(t_ns, values[:, 1:])
    return Trajectory.from_quat_xyzw(t_ns, values[:, 1:4], quat)


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


def _read_text(path: Path) -> str:
    try:
        data = path.read_bytes()
        if data.startswith(_GZIP_MAGIC):
            data = gzip.decompress(data)
        return data.decode("utf-8-sig")
    except FileNotFoundError:
        raise TrajectoryError(f"{path}: no such trajectory file; check the path") from None
    except UnicodeDecodeError:
        raise TrajectoryError(f"{path}: not a text file; give a TUM or EuRoC trajectory") from None
    except (OSError, EOFError) as error:
        raise TrajectoryError(f"{path}: cannot be read ({error}); give a TUM or EuRoC trajectory") from None


def _split(name: str, text: str, keep_first_of_repeats: bool) -> _Table:
    header = ""
    comma_separated = False
    lines: list[int] = []
    rows: list[list[str]] = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line:
            continue
        if line.startswith(("#", "%")) or (not rows and line[0].isalpha()):
            header = header or line
            continue
        if not rows:
            comma_separated = "," in line
        # VINS-Mono ends each line of its csv with a comma.
        fields = line.rstrip(",").split(",") if comma_separated else line.split()
        if rows and len(fields) != len(rows[0]):
            raise TrajectoryError(
                f"{name}, line {number}: {len(fields)} columns where line {lines[0]} has {len(rows[0])}"
            )
        if not (keep_first_of_repeats and rows and fields[0] == rows[-1][0]):
            rows.append(fields)
            lines.append(number)
    if not rows:
        raise TrajectoryError(f"{name}: holds no poses; give a TUM or EuRoC trajectory")
    return _Table(name, header, comma_separated, lines, rows)


def _refuse_motion_capture(path: Path, table: _Table) -> None:
    columns = len(table.rows[0])
    # EuRoC's vicon0/data.csv has the column names of its ground truth, but stops after the quaternion.
    vicon_columns = table.comma_separated and columns == 8 and "p_RS_R_x" in table.header
    if columns == 4 or vicon_columns or _MOTION_CAPTURE.search(f"{path.parent.name}/{path.name}"):
        raise TrajectoryError(
            f"{path}: raw Vicon or Leica measurements are not a body trajectory in the cameras' clock; "
            "use state_groundtruth_estimate0/data.csv of the ASL folder"
        )


def _stamps(table: _Table, unit: int) -> Int:
    """(N,) ns, from the first column in units of ``unit`` ns."""
    stamps: list[int] = []
    for row, fields in enumerate(table.rows):
        try:
            value = Decimal(fields[0]) * unit
        except InvalidOperation:
            raise table.error(row, f"the stamp {fields[0]!r} is not a number") from None
        if not value.is_finite() or abs(value) > _INT64_MAX:
            hint = " seconds; are the stamps nanoseconds? separate EuRoC columns by commas" if unit != 1 else " ns"
            raise table.error(row, f"the stamp {fields[0]} is not a time in{hint}")
        if unit == 1 and value != value.to_integral_value():
            raise table.error(
                row, f"the stamp {fields[0]} is not integer nanoseconds; TUM files are separated by blanks"
            )
        stamps.append(int(value.to_integral_value()))
    return np.array(stamps, dtype=np.int64)


def _check_order(table: _Table, t_ns: Int) -> None:
    backwards = np.flatnonzero(np.diff(t_ns) <= 0)
    if backwards.size:
        row = int(backwards[0]) + 1
        kind = "repeats" if t_ns[row] == t_ns[row - 1] else "is before"
        stamp = table.rows[row][0]
        raise table.error(row, f"the stamp {stamp} {kind} that of line {table.lines[row - 1]}; sort or drop such lines")


def _values(table: _Table) -> Float:
    """(N, columns) as floats; the poses, which are the first eight but the stamp, all finite."""
    rows: Sequence[Sequence[str]] = table.rows
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError:
        values = np.array([[_float_or_nan(field) for field in fields] for fields in rows])
    finite = np.isfinite(values[:, :8]).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise table.error(row, f"the pose is not finite: {' '.join(rows[row][1:8])}")
    return values


def _float_or_nan(field: str) -> float:
    try:
        return float(field)
    except ValueError:
        return float("nan")
