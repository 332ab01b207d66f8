"""Point clouds: `sensor_msgs/PointCloud2` bodies in either encoding, and a small reader for `.ply` scans."""

from itertools import cycle
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

CLOUD_TYPE: Final = "sensor_msgs/msg/PointCloud2"
_UINT16: Final = 4  # sensor_msgs/PointField.UINT16
_FLOAT32: Final = 7  # sensor_msgs/PointField.FLOAT32
_MAX_HEADER_BYTES: Final = 65536
_DTYPES: Final = {
    **{"char": "<i1", "uchar": "<u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"},
    **{"int8": "<i1", "uint8": "<u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4"},
    **{"float": "<f4", "double": "<f8", "float32": "<f4", "float64": "<f8"},
}
_INTENSITY: Final = ("intensity", "scalar_intensity", "scalar_Intensity")


def read_ply(path: Path) -> NDArray[np.float32]:
    """(n, 3) x y z, or (n, 4) with intensity where the file has it. ASCII or binary little endian.

    Only the vertices are read, which must be the first element. ConfigError, one line, for anything else.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", file=str(path)) from None
    head, mark, data = raw[:_MAX_HEADER_BYTES].partition(b"end_header")
    lines = head.decode("ascii", errors="replace").splitlines()
    if not mark or not lines or lines[0].strip() != "ply":
        raise ConfigError("is not a PLY file", file=str(path))
    data = raw[len(head) + len(mark) :].partition(b"\n")[2]
    kind, count, columns = _header(path, [line.split() for line in lines[1:]])
    if kind == "ascii":
        rows = data.decode("ascii", errors="replace").splitlines()[:count]
        try:
            table = np.array([row.split()[: len(columns)] for row in rows], dtype=np.float64)
            table = table.reshape(count, len(columns))
        except ValueError as error:
            raise ConfigError(f"damaged vertex data ({error}); export it again", file=str(path)) from None
        by_name = {name: table[:, i] for i, (name, _) in enumerate(columns)}
    else:
        dtype = np.dtype(columns)
        if len(data) < count * dtype.itemsize:
            raise ConfigError(f"ends before its {count} vertices; copy it again", file=str(path))
        vertices = np.frombuffer(data, dtype=dtype, count=count)
        by_name = {name: vertices[name] for name, _ in columns}
    wanted = ["x", "y", "z", *[name for name in _INTENSITY if name in by_name][:1]]
    return np.stack([by_name[name] for name in wanted], axis=1).astype(np.float32)


def _header(path: Path, lines: list[list[str]]) -> tuple[str, int, list[tuple[str, str]]]:
    """(format, number of vertices, columns as (name, dtype))."""
    kind, count, columns, element = "", -1, list[tuple[str, str]](), 0
    for words in lines:
        match words:
            case ["format", ("ascii" | "binary_little_endian") as kind, "1.0"]:
                pass
            case ["format", other, *_]:
                raise ConfigError(f"format {other} is not supported; use ascii or binary_little_endian", file=str(path))
            case ["element", "vertex", number] if element == 0 and number.isdigit():
                count, element = int(number), element + 1
            case ["element", *_]:
                element += 1
            case ["property", type_name, name] if element == 1 and type_name in _DTYPES:
                columns.append((name, _DTYPES[type_name]))
            case ["property", *_] if element == 1:
                raise ConfigError(f"vertex property {' '.join(words[1:])} is not supported", file=str(path))
            case _:
                pass  # comments, and properties of later elements
    if not kind or count < 0 or not {"x", "y", "z"} <= {name for name, _ in columns}:
        raise ConfigError("has no vertices with x, y and z as its first element", file=str(path))
    return kind, count, columns


def cloud_body(points: NDArray[np.float32], stamp_ns: int, frame_id: str, encoding: Encoding, seq: int = 0) -> bytes:
    """A PointCloud2 body of (n, 3) x y z, (n, 4) x y z intensity or (n, 5) x y z intensity label; unordered, little
    endian. The label goes as uint16, all else as float32.
    """
    names = ("x", "y", "z", "intensity", "label")[: points.shape[1]]
    fields = [
        ros_types.new(
            "sensor_msgs/msg/PointField",
            encoding,
            name=name,
            offset=4 * i,
            datatype=_UINT16 if name == "label" else _FLOAT32,
            count=1,
        )
        for i, name in enumerate(names)
    ]
    numbers = np.ascontiguousarray(points[:, :4], dtype="<f4")
    data = numbers.view(np.uint8).reshape(len(points), 4 * numbers.shape[1])
    if "label" in names:
        labels = np.ascontiguousarray(points[:, 4:5], dtype="<u2").view(np.uint8)
        data = np.concatenate([data, labels.reshape(len(points), 2)], axis=1)
    step = data.shape[1]
    message = ros_types.new(
        CLOUD_TYPE,
        encoding,
        header=ros_types.header(stamp_ns, frame_id, encoding, seq),
        height=1,
        width=len(points),
        fields=fields,
        point_step=step,
        row_step=step * len(points),
        data=data.reshape(-1),
        is_dense=not bool(np.isnan(points).any()),
    )
    return ros_types.serialise(message, CLOUD_TYPE, encoding)


class CloudSource:
    """Plays scans read from `.ply` files in turn, for ever."""

    def __init__(self, files: tuple[Path, ...], encoding: Encoding, frame_id: str = "velodyne") -> None:
        """Reads every file now. ConfigError when one cannot be used, or none is given."""
        if not files:
            raise ConfigError("cloud_files names no file")
        self._scans = cycle([read_ply(path) for path in files])
        self._encoding = encoding
        self._frame_id = frame_id
        self._seq = 0

    def next_body(self, stamp_ns: int) -> bytes:
        self._seq += 1
        return cloud_body(next(self._scans), stamp_ns, self._frame_id, self._encoding, self._seq)
