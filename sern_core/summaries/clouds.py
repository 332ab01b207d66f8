"""sensor_msgs/PointCloud2 bodies as numpy arrays over the same bytes.

    header | height | width | fields[] {name, offset, datatype, count} | is_bigendian | point_step | row_step | data[] |
    is_dense

A point is `point_step` bytes, a row `row_step` (at least width * point_step: rows may be padded).
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.bodies import BodyReader, BodyWriter, Header
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding

CLOUD_TYPE: Final = "sensor_msgs/msg/PointCloud2"
MAX_FIELDS: Final = 64
MAX_COORDINATE_M: Final = 1e9
"""A coordinate beyond this is no place on Earth; such points count as invalid, like those that are not finite."""
_KINDS: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField datatypes INT8 to FLOAT64."""


@dataclass(frozen=True, slots=True)
class Field:
    """sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int = 1

    @property
    def nbytes(self) -> int:
        """BodyError for a datatype that PointField does not define."""
        kind = _KINDS.get(self.datatype)
        if kind is None:
            raise BodyError(f"field {self.name!r} has datatype {self.datatype}, which PointField does not define")
        return int(kind[1]) * max(self.count, 1)  # some writers leave 0 for 1


@dataclass(frozen=True, slots=True)
class Cloud:
    """A cloud whose sizes fit each other. `points` is (height * width, point_step) bytes, without row padding."""

    header: Header
    height: int
    width: int
    fields: tuple[Field, ...]
    bigendian: bool
    points: NDArray[np.uint8]
    dense: bool

    @property
    def point_step(self) -> int:
        return int(self.points.shape[1])

    def field(self, name: str) -> Field | None:
        return next((field for field in self.fields if field.name == name), None)

    def column(self, name: str) -> NDArray[Any]:
        """(n,) values of a field of one number, in the field's own type; a view. BodyError when there is none such."""
        field = self.field(name)
        if field is None:
            raise BodyError(f"the cloud has no field {name!r}")
        if field.nbytes + field.offset > self.point_step:
            raise BodyError(f"field {name!r} reaches beyond the point_step of {self.point_step}")
        kind = np.dtype((">" if self.bigendian else "<") + _KINDS[field.datatype])
        points = self.points
        if not len(points):
            return np.empty(0, kind)
        # Rows may be padded, so the points need not lie end to end; the bytes of one field of a point do.
        return points[:, field.offset : field.offset + kind.itemsize].view(kind)[:, 0]

    def xyz(self) -> NDArray[np.float32] | NDArray[np.float64]:
        """(n, 3) coordinates in metres, native byte order; float64 if any of them is wider than float32."""
        if not len(self.points):
            return np.empty((0, 3), np.float32)  # a cloud without points often comes without fields
        columns = [self.column(name) for name in "xyz"]
        if any(column.dtype.kind != "f" for column in columns):
            raise BodyError("x, y and z must be FLOAT32 or FLOAT64")
        wide = any(column.dtype.itemsize > 4 for column in columns)
        # Column by column in memory: what is done with all x takes a third of the time.
        return np.stack([column.astype(np.float64 if wide else np.float32) for column in columns]).T

    def put_xyz(self, values: NDArray[Any]) -> None:
        """Overwrite the coordinates; `points` must be writable."""
        for i, name in enumerate("xyz"):
            self.column(name)[:] = values[:, i]

    def take(self, rows: NDArray[np.intp], keep: tuple[str, ...] | None = None) -> "Cloud":
        """A new unorganised cloud of these points, with the padding between fields left out.

        `keep`: only these fields, beside x, y and z; None: all. BodyError when a field reaches beyond the point.
        """
        kept = [field for field in self.fields if keep is None or field.name in "xyz" or field.name in keep]
        pieces: list[NDArray[np.uint8]] = []
        fields: list[Field] = []
        at = 0
        for field in kept:
            end = field.offset + field.nbytes
            if end > self.point_step:
                raise BodyError(f"field {field.name!r} reaches beyond the point_step of {self.point_step}")
            pieces.append(self.points[:, field.offset : end])
            fields.append(replace(field, offset=at))
            at += field.nbytes
        if at >= self.point_step:  # nothing to gain, or fields that overlap: their layout stays as it is
            fields = list(self.fields)
            points = self.points[rows]
        else:
            points = np.empty((len(rows), at), np.uint8)
            for field, piece in zip(fields, pieces, strict=True):
                points[:, field.offset : field.offset + field.nbytes] = piece[rows]
        return Cloud(self.header, 1, len(rows), tuple(fields), self.bigendian, points, dense=True)


def valid_rows(xyz: NDArray[Any]) -> NDArray[np.bool_]:
    """(n,) which points have coordinates: finite and below MAX_COORDINATE_M."""
    with np.errstate(invalid="ignore"):
        near: NDArray[np.bool_] = np.abs(xyz) < MAX_COORDINATE_M  # false for NaN
    return near[:, 0] & near[:, 1] & near[:, 2]


def read_cloud(body: bytes, encoding: Encoding) -> Cloud:
    """The cloud in `body`, as a view of it. BodyError when its sizes contradict each other."""
    reader = BodyReader(body, encoding)
    header = reader.header()
    height, width = reader.u32(), reader.u32()
    count = reader.u32()
    if count > MAX_FIELDS:
        raise BodyError(f"a point of {count} fields; up to {MAX_FIELDS} are read")
    fields = tuple(Field(reader.text(), reader.u32(), reader.u8(), reader.u32()) for _ in range(count))
    bigendian = bool(reader.u8())
    point_step, row_step = reader.u32(), reader.u32()
    data = np.frombuffer(reader.array(1), np.uint8)
    dense = bool(reader.u8())
    reader.end()
    total = height * width
    if total and point_step == 0:
        raise BodyError("point_step is 0")
    if height > 1 and row_step < width * point_step:
        raise BodyError(f"row_step {row_step} is less than {width} points of {point_step} bytes")
    row_step = row_step if height > 1 else width * point_step  # of a single row nobody looks at it
    if total and (height - 1) * row_step + width * point_step > len(data):
        raise BodyError(f"{len(data)} bytes of data for {height} x {width} points of {point_step} bytes")
    if not total:
        points: NDArray[np.uint8] = np.empty((0, point_step), np.uint8)
    elif row_step == width * point_step:
        points = data[: total * point_step].reshape(total, point_step)
    else:
        padded = np.zeros(height * row_step, np.uint8)  # the last row may come without its padding
        used = data[: len(padded)]
        padded[: len(used)] = used
        points = padded.reshape(height, row_step)[:, : width * point_step].reshape(total, point_step)
    return Cloud(header, height, width, fields, bigendian, points, dense)


def write_cloud(cloud: Cloud, encoding: Encoding) -> bytes:
    """The body of a cloud; rows without padding."""
    writer = BodyWriter(encoding)
    writer.header(cloud.header)
    writer.u32(cloud.height)
    writer.u32(cloud.width)
    writer.u32(len(cloud.fields))
    for field in cloud.fields:
        writer.text(field.name)
        writer.u32(field.offset)
        writer.u8(field.datatype)
        writer.u32(field.count)
    writer.u8(cloud.bigendian)
    writer.u32(cloud.point_step)
    writer.u32(cloud.point_step * cloud.width)
    writer.array(cloud.points.tobytes(), 1)
    writer.u8(cloud.dense)
    return writer.body()
