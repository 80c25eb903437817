"""Videos as a GoPro writes them: MPEG-4 with a track of telemetry (GPMF) beside the pictures."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from vioframe.types import Float, Image

# A block of telemetry is of about a second.
_PER_BLOCK = 200
_SCALE = {b"ACCL": 417, b"GYRO": 939}
_TIMESCALE = 1_000_000


def write_video(path: Path, images: Iterable[Image], rate_hz: float) -> int:
    """Pictures alone; returns how many there are."""
    writer, count = None, 0
    for image in images:
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, image.shape[::-1])
            assert writer.isOpened()
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        count += 1
    assert writer is not None
    writer.release()
    return count


def add_telemetry(path: Path, gyro: Float, accel: Float, rate_hz: float, model: str = "HERO9 Black") -> None:
    """Give the video at ``path`` a track of readings (N, 3), rad/s and m/s^2, from its beginning on.

    Their axes are in the order in which GoPro's first model had them, as whoever reads them is to have them: z, x, y.
    """
    blocks = []
    for first in range(0, len(gyro), _PER_BLOCK):
        part = slice(first, first + _PER_BLOCK)
        count = len(gyro[part])
        streams = [
            _stream(b"ACCL", "Accelerometer", "m/s²", accel[part], first, round(1e6 * first / rate_hz)),
            _stream(b"GYRO", "Gyroscope", "rad/s", gyro[part], first, round(1e6 * first / rate_hz)),
        ]
        blocks.append((_klv(b"DEVC", b"\0", 1, _text(b"DVNM", model), *streams), round(_TIMESCALE * count / rate_hz)))
    data = path.read_bytes()
    boxes = dict(_boxes(data))
    movie = boxes.pop(b"moov")
    front = b"".join(boxes.values())
    assert data == front + movie  # the pictures stay where they are
    telemetry = _box(b"mdat", *(payload for payload, _ in blocks))
    track = _telemetry_track(blocks, len(front) + 8)
    path.write_bytes(front + telemetry + _box(b"moov", movie[8:], track))


def _telemetry_track(blocks: Sequence[tuple[bytes, int]], offset: int) -> bytes:
    """The track whose samples are the ``blocks``, with their durations, from byte ``offset`` of the file on."""
    durations = b"".join(struct.pack(">II", 1, duration) for _, duration in blocks)
    sizes = b"".join(struct.pack(">I", len(payload)) for payload, _ in blocks)
    length = sum(duration for _, duration in blocks)
    table = _box(
        b"stbl",
        _full(b"stsd", struct.pack(">I", 1), _box(b"gpmd", bytes(6), struct.pack(">HI", 1, 0))),
        _full(b"stts", struct.pack(">I", len(blocks)), durations),
        _full(b"stsc", struct.pack(">IIII", 1, 1, len(blocks), 1)),
        _full(b"stsz", struct.pack(">II", 0, len(blocks)), sizes),
        _full(b"stco", struct.pack(">II", 1, offset)),
    )
    reference = _box(b"dinf", _full(b"dref", struct.pack(">I", 1), _box(b"url ", b"\0\0\0\1")))
    handler = _full(b"hdlr", b"mhlrmeta", bytes(12), b"GoPro MET\0")
    media = _box(
        b"mdia",
        _full(b"mdhd", struct.pack(">IIIIHH", 0, 0, _TIMESCALE, length, 0x55C4, 0)),
        handler,
        _box(b"minf", _box(b"gmhd", _full(b"gmin", bytes(12))), reference, table),
    )
    unity = struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    header = struct.pack(">IIIII", 0, 0, 3, 0, length // (_TIMESCALE // 1000)) + bytes(16) + unity + bytes(8)
    return _box(b"trak", _full(b"tkhd", header), media)


def _stream(key: bytes, name: str, unit: str, values: Float, before: int, t_us: int) -> bytes:
    """A block of readings, of which ``before`` came earlier, the first at ``t_us``; stored as by a HERO9: y, -x, z."""
    scale = _SCALE[key]
    z, x, y = values.T
    stored = np.round(scale * np.column_stack([y, -x, z])).astype(">i2")
    return _klv(
        b"STRM",
        b"\0",
        1,
        _klv(b"STMP", b"J", 8, struct.pack(">Q", t_us)),
        _klv(b"TSMP", b"L", 4, struct.pack(">I", before + len(values))),
        _text(b"STNM", name),
        _text(b"ORIN", "YxZ"),
        _text(b"ORIO", "ZXY"),
        _text(b"SIUN", unit),
        _klv(b"SCAL", b"s", 2, struct.pack(">h", scale)),
        _klv(key, b"s", 6, stored.tobytes()),
    )


def _text(key: bytes, text: str) -> bytes:
    raw = text.encode("latin-1")
    return _klv(key, b"c", len(raw), raw)


def _klv(key: bytes, kind: bytes, size: int, *parts: bytes) -> bytes:
    payload = b"".join(parts)
    return key + struct.pack(">sBH", kind, size, len(payload) // size) + payload + bytes(-len(payload) % 4)


def _box(kind: bytes, *parts: bytes) -> bytes:
    payload = b"".join(parts)
    return struct.pack(">I", 8 + len(payload)) + kind + payload


def _full(kind: bytes, *parts: bytes) -> bytes:
    return _box(kind, bytes(4), *parts)


def _boxes(data: bytes) -> list[tuple[bytes, bytes]]:
    out, at = [], 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        out.append((kind, data[at : at + size]))
        at += size
    return out
