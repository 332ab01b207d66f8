"""The lossy codecs: point clouds, thinned and packed by Draco, and images as JPEG. Only where a topic allows them.

What comes out is a normal message of the same type and serialisation with the same header. Of a point cloud, x, y and
z survive as float32, one point (the mean) for each occupied voxel, unorganised, in no particular order; each coordinate
is off by at most `QUANTUM` / 2 of a voxel from that mean, and what float32 rounds. Of an image everything survives but
the exact pixels and the padding at the end of rows; `rgb8`, `bgr8` and `mono8` are taken, others (depth above all) are
not, and are sent without loss.

After the raw size (`sern_core.bodies.codecs`) a body is

    +------------------+--------------+---------------------------------+------------------+
    | serialisation u8 | head size u16| head: the message with no data  | Draco, or JPEG   |
    +------------------+--------------+---------------------------------+------------------+

serialisation 0: ros1, 1: cdr. Draco's decoder is C++ that has seen hostile input less often than the others: the number
of points is compared with the raw size before it is called. DracoPy does not release the interpreter lock; thinned
clouds keep that short.
"""

import io
import struct
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sern_core.summaries.bodies import BodyReader, BodyWriter, Header
from sern_core.summaries.clouds import Cloud, Field, read_cloud, write_cloud
from sern_core.summaries.voxel import thin_rows
from sern_core.vocabulary.codec_names import LossyParams
from sern_core.vocabulary.errors import BodyError, CodecError
from sern_core.vocabulary.types import Encoding

QUANTUM: Final = 0.1
"""Draco's grid, in voxels."""
MAX_BITS: Final = 24
"""More bits than float32 has to say."""
DRACO_LEVEL: Final = 5
DRACO_NUM_POINTS_AT: Final = 11
"""Where the number of points stands in a Draco buffer: "DRACO", version u8 u8, geometry u8 (0: point cloud), method u8,
flags u16, then points i32."""
MAX_SIDE: Final = 65_500
"""What JPEG can hold."""
CLOUD_TYPE: Final = "sensor_msgs/PointCloud2"
IMAGE_TYPE: Final = "sensor_msgs/Image"
NEEDS: Final = {"voxel_draco": "DracoPy", "jpeg": "PIL"}
_HEAD: Final = struct.Struct("!BH")
_POINT_BYTES: Final = 12
_XYZ: Final = tuple(Field(name, 4 * i, 7) for i, name in enumerate("xyz"))
_KINDS: Final = (Encoding.ROS1, Encoding.CDR)
_PIXELS: Final = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def missing(mode: str) -> str | None:
    """What to install for a lossy mode; None when it is there."""
    module = NEEDS[mode]
    if find_spec(module) is not None:
        return None
    package = "pillow" if module == "PIL" else module
    return f"{mode} needs the Python package {package}: pip install {package}"


def _library(mode: str, name: str) -> Any:
    """Raises CodecError with what to install."""
    problem = missing(mode)
    if problem is not None:
        raise CodecError(problem)
    return import_module(name)


def _pack(encoding: Encoding, head: bytes, data: bytes) -> bytes:
    if encoding not in _KINDS or len(head) > 0xFFFF:
        raise CodecError("neither ros1 nor cdr, or a head too long")
    return _HEAD.pack(_KINDS.index(encoding), len(head)) + head + data


def _unpack(packed: memoryview) -> tuple[Encoding, bytes, memoryview]:
    if len(packed) < _HEAD.size:
        raise CodecError("truncated lossy body")
    kind, length = _HEAD.unpack_from(packed)
    if kind >= len(_KINDS) or len(packed) < _HEAD.size + length:
        raise CodecError("a lossy body whose head is no head")
    at = _HEAD.size + length
    return _KINDS[kind], bytes(packed[_HEAD.size : at]), packed[at:]


# Point clouds ---------------------------------------------------------------------------------------------------------


def encode_cloud(body: bytes, encoding: Encoding, params: LossyParams) -> tuple[int, bytes]:
    """(raw size of what will come out, packed) of a sensor_msgs/PointCloud2. CodecError when it cannot be."""
    draco = _library("voxel_draco", "DracoPy")
    try:
        cloud = read_cloud(body, encoding)
        _rows, centroids = thin_rows(cloud.xyz(), params.voxel_m)
    except BodyError as error:
        raise CodecError(str(error)) from None
    head = write_cloud(Cloud(cloud.header, 1, 0, _XYZ, False, np.empty((0, _POINT_BYTES), np.uint8), True), encoding)
    if centroids is None or not len(centroids):
        return len(head), _pack(encoding, head, b"")
    origin = centroids.min(axis=0)
    span_m = max(float((centroids.max(axis=0) - origin).max()), params.voxel_m)
    bits = int(np.ceil(np.log2(span_m / (QUANTUM * params.voxel_m) + 1.0)))
    if bits > MAX_BITS:
        raise CodecError(f"a cloud {span_m:g} m wide in voxels of {params.voxel_m:g} m")
    data: bytes = draco.encode(
        np.ascontiguousarray(centroids - origin, np.float32),
        quantization_bits=bits,
        quantization_range=span_m,
        quantization_origin=np.zeros(3, np.float32),
        compression_level=DRACO_LEVEL,
    )
    shift = struct.pack("!3d", *origin)
    return len(head) + _POINT_BYTES * _draco_points(data), _pack(encoding, head, shift + data)


def _draco_points(data: bytes | memoryview) -> int:
    """How many points a Draco buffer says it holds. CodecError for what is no plain point cloud."""
    if len(data) < DRACO_NUM_POINTS_AT + 4 or bytes(data[:5]) != b"DRACO" or data[7] != 0 or data[9] or data[10]:
        raise CodecError("no Draco point cloud")
    return int(struct.unpack_from("<I", data, DRACO_NUM_POINTS_AT)[0])


def decode_cloud(packed: memoryview, size: int) -> bytes:
    """The PointCloud2 body of `size` bytes that `encode_cloud` announced. CodecError."""
    encoding, head, data = _unpack(packed)
    try:
        empty = read_cloud(head, encoding)
    except BodyError as no_cloud:
        raise CodecError(str(no_cloud)) from None
    if empty.fields != _XYZ or len(empty.points):
        raise CodecError("a lossy cloud whose head has other fields or data")
    if not len(data):
        return head
    if len(data) < 24:
        raise CodecError("truncated lossy cloud")
    origin = np.array(struct.unpack_from("!3d", data))
    buffer = bytes(data[24:])
    count = _draco_points(buffer)
    if len(head) + _POINT_BYTES * count != size:
        raise CodecError(f"a cloud of {count} points in a body that claims {size} bytes")
    draco = _library("voxel_draco", "DracoPy")
    try:
        decoded = np.asarray(draco.decode(buffer).points, np.float64)
    except (draco.FileTypeException, draco.EncodingFailedException, ValueError, MemoryError, RuntimeError) as error:
        raise CodecError(f"a damaged Draco buffer ({type(error).__name__})") from None
    if decoded.shape != (count, 3):
        raise CodecError(f"a Draco buffer of shape {decoded.shape}, not of {count} points")
    with np.errstate(all="ignore"):
        points: NDArray[np.uint8] = np.ascontiguousarray(decoded + origin, "<f4").view(np.uint8)
    return write_cloud(replace(empty, width=count, points=points.reshape(count, _POINT_BYTES)), encoding)


# Images ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Image:
    """sensor_msgs/Image of a kind that JPEG takes; `data` (height * step) bytes."""

    header: Header
    height: int
    width: int
    kind: str
    bigendian: int
    step: int
    data: bytes | memoryview

    @property
    def row_bytes(self) -> int:
        return self.width * _PIXELS[self.kind]


def read_image(body: bytes, encoding: Encoding) -> Image:
    """BodyError for what is no image, or none of `rgb8`, `bgr8`, `mono8`."""
    reader = BodyReader(body, encoding)
    header = reader.header()
    height, width = reader.u32(), reader.u32()
    kind = reader.text()
    bigendian, step = reader.u8(), reader.u32()
    data = reader.array(1)
    reader.end()
    if kind not in _PIXELS:
        raise BodyError(f"an image of encoding {kind!r}; {', '.join(_PIXELS)} can be JPEG")
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
        raise BodyError(f"an image of {width} x {height} pixels; JPEG takes 1 to {MAX_SIDE}")
    return Image(header, height, width, kind, bigendian, step, data)


def write_image(image: Image, encoding: Encoding) -> bytes:
    writer = BodyWriter(encoding)
    writer.header(image.header)
    writer.u32(image.height)
    writer.u32(image.width)
    writer.text(image.kind)
    writer.u8(image.bigendian)
    writer.u32(image.step)
    writer.array(image.data, 1)
    return writer.body()


def encode_image(body: bytes, encoding: Encoding, params: LossyParams) -> tuple[int, bytes]:
    """(raw size of what will come out, packed) of a sensor_msgs/Image. CodecError when it cannot be."""
    pillow = _library("jpeg", "PIL.Image")
    try:
        image = read_image(body, encoding)
    except BodyError as error:
        raise CodecError(str(error)) from None
    row_bytes = image.row_bytes
    if image.step < row_bytes or image.step * (image.height - 1) + row_bytes > len(image.data):
        raise CodecError(f"{len(image.data)} bytes of data for {image.height} rows of {image.step}")
    raw_mode = {"rgb8": "RGB", "bgr8": "BGR", "mono8": "L"}[image.kind]
    mode = "L" if image.kind == "mono8" else "RGB"
    picture = pillow.frombuffer(mode, (image.width, image.height), image.data, "raw", raw_mode, image.step, 1)
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=params.jpeg_quality)
    head = write_image(replace(image, step=row_bytes, data=b""), encoding)
    return len(head) + image.height * row_bytes, _pack(encoding, head, out.getvalue())


def decode_image(packed: memoryview, size: int) -> bytes:
    """The Image body of `size` bytes that `encode_image` announced. CodecError."""
    encoding, head, data = _unpack(packed)
    try:
        empty = read_image(head, encoding)
    except BodyError as no_image:
        raise CodecError(str(no_image)) from None
    if len(empty.data) or empty.step != empty.row_bytes or len(head) + empty.height * empty.step != size:
        raise CodecError("a lossy image whose head does not fit its size")
    pillow = _library("jpeg", "PIL.Image")
    mode = "L" if empty.kind == "mono8" else "RGB"
    try:
        # The plugin itself: no other format is tried, and its size is known before anything is unpacked.
        picture = _library("jpeg", "PIL.JpegImagePlugin").JpegImageFile(io.BytesIO(data))
        if picture.size != (empty.width, empty.height) or picture.mode != mode:
            raise CodecError(f"a JPEG of {picture.size}, {picture.mode} for an image of {empty.width}, {empty.height}")
        pixels: bytes = picture.tobytes("raw", "BGR" if empty.kind == "bgr8" else mode)
    except (OSError, SyntaxError, ValueError, MemoryError, struct.error, pillow.DecompressionBombError) as error:
        raise CodecError(f"a damaged JPEG ({type(error).__name__})") from None
    return write_image(replace(empty, data=pixels), encoding)
