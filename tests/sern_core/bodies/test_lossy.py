"""The lossy codecs: what survives and how exactly, what is refused, and what an absent library says."""

import importlib.util
import struct
import tracemalloc
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sern_client.endpoints.clouds import cloud_body, read_ply
from sern_core.bodies import codecs, lossy
from sern_core.bodies.codecs import SIZE, Coder, LossyTopic, decode, encode
from sern_core.summaries.clouds import read_cloud
from sern_core.summaries.voxel import thin_rows
from sern_core.vocabulary.codec_names import Codec, Compression, LossyParams
from sern_core.vocabulary.errors import CodecError, UsageError
from sern_core.vocabulary.types import Encoding, PriorityClass
from sern_runtime import ros_types
from sern_sim.models import LinkModel
from tests.daemons import recording
from tests.exploring import cases
from tests.world import World, spec

pytest.importorskip("DracoPy", reason="the Python package DracoPy (extra lossy) is not installed")
pytest.importorskip("PIL", reason="the Python package Pillow (extra lossy) is not installed")

STEADY = settings(max_examples=cases(100))
CAP = 16 << 20
STAMP_NS = 1_700_000_000_123_456_789
ENCODINGS = (Encoding.ROS1, Encoding.CDR)
IMAGE = "sensor_msgs/msg/Image"


def cloud_topic(encoding: Encoding, voxel_m: float = 0.1) -> LossyTopic:
    return LossyTopic((Compression.VOXEL_DRACO,), encoding, LossyParams(voxel_m=voxel_m))


def image_topic(encoding: Encoding, quality: int = 75) -> LossyTopic:
    return LossyTopic((Compression.JPEG,), encoding, LossyParams(jpeg_quality=quality))


def room(count: int, scale: float = 10.0) -> NDArray[np.float32]:
    """Points on the walls of a room, with intensity."""
    rng = np.random.default_rng(4)
    points = rng.uniform(-scale, scale, (count, 4)).astype(np.float32)
    points[np.arange(count), rng.integers(0, 3, count)] = scale
    return points


def image_body(pixels: NDArray[np.uint8], kind: str, encoding: Encoding, padding: int = 0) -> bytes:
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    message = ros_types.new(
        IMAGE,
        encoding,
        header=ros_types.header(STAMP_NS, "camera", encoding, 7),
        height=height,
        width=width,
        encoding=kind,
        is_bigendian=0,
        step=padded.shape[1],
        data=np.ascontiguousarray(padded).reshape(-1),
    )
    return ros_types.serialise(message, IMAGE, encoding)


def scene(height: int, width: int, channels: int) -> NDArray[np.uint8]:
    """Smooth, as photographs mostly are."""
    y, x = np.mgrid[0:height, 0:width]
    layers = [127 + 100 * np.sin(x / (20 + 9 * c)) * np.cos(y / 31) for c in range(channels)]
    return np.stack(layers, axis=-1).astype(np.uint8)


# --- point clouds -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("voxel_m", [0.05, 0.3])
@pytest.mark.parametrize("scan", ["room", "lidar_scan_a.ply"])
def test_a_cloud_comes_back_thinned_and_exact_to_a_twentieth_of_a_voxel(
    encoding: Encoding, voxel_m: float, scan: str
) -> None:
    points = room(20_000) if scan == "room" else read_ply(recording(scan))
    points[::1000, 0] = np.nan
    body = cloud_body(points, STAMP_NS, "velodyne", encoding, 5)
    codec, packed = encode(Compression.VOXEL_DRACO, body, cloud_topic(encoding, voxel_m))
    assert codec is Codec.DRACO
    assert len(packed) < 0.2 * len(body)
    raw = decode(codec, packed, max_bytes=CAP)
    before = ros_types.deserialise(body, "sensor_msgs/msg/PointCloud2", encoding)
    after = ros_types.deserialise(raw, "sensor_msgs/msg/PointCloud2", encoding)
    assert after.header == before.header
    assert [(field.name, field.datatype) for field in after.fields] == [("x", 7), ("y", 7), ("z", 7)]
    assert (after.height, after.point_step, after.is_dense) == (1, 12, True)
    got = read_cloud(raw, encoding).xyz().astype(np.float64)
    _rows, wanted = thin_rows(points[:, :3], voxel_m)
    assert wanted is not None
    assert len(wanted) * 0.95 <= len(got) <= len(wanted)
    bound = lossy.QUANTUM * voxel_m / 2 + 1e-5
    # Each point has a mean within the bound on every axis, and each mean a point.
    assert _farthest(got, wanted, bound) <= bound
    assert _farthest(wanted, got, bound) <= bound


def _farthest(points: NDArray[np.float64], others: NDArray[np.float64], bound: float) -> float:
    """The largest, over `points`, of the distance along an axis to the nearest of `others`, searched near the bound.

    The search is along a slanted line: along an axis a whole wall lies in one place."""
    slant = np.array([1.0, 0.618, 0.382])
    near_by = 2 * bound * slant.sum()
    along = others @ slant
    order = np.argsort(along)
    low = np.searchsorted(along[order], points @ slant - near_by)
    high = np.searchsorted(along[order], points @ slant + near_by)
    worst = 0.0
    for point, start, stop in zip(points, low, high, strict=True):
        near = others[order[start:stop]]
        worst = max(worst, float(np.abs(near - point).max(axis=1).min()) if len(near) else np.inf)
    return worst


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_far_from_the_origin_nothing_is_lost_beside_float32(encoding: Encoding) -> None:
    points = room(2000)
    points[:, 0] += 4000.0
    body = cloud_body(points, STAMP_NS, "map", encoding)
    codec, packed = encode(Compression.VOXEL_DRACO, body, cloud_topic(encoding))
    got = read_cloud(decode(codec, packed, max_bytes=CAP), encoding).xyz()
    _rows, wanted = thin_rows(points[:, :3], 0.1)
    assert wanted is not None
    assert _farthest(got.astype(np.float64), wanted, 0.006) <= 0.005 + 3e-4


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_cloud_without_a_valid_point_becomes_an_empty_one(encoding: Encoding) -> None:
    body = cloud_body(np.full((100, 3), np.nan, np.float32), STAMP_NS, "velodyne", encoding)
    codec, packed = encode(Compression.VOXEL_DRACO, body, cloud_topic(encoding))
    assert len(read_cloud(decode(codec, packed, max_bytes=CAP), encoding).points) == 0


# --- images -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("kind", "channels"), [("rgb8", 3), ("bgr8", 3), ("mono8", 1)])
@pytest.mark.parametrize("padding", [0, 5])
def test_an_image_keeps_its_shape_and_nearly_its_pixels(
    encoding: Encoding, kind: str, channels: int, padding: int
) -> None:
    pixels = scene(120, 161, channels)
    codec, packed = encode(
        Compression.JPEG, image_body(pixels, kind, encoding, padding), image_topic(encoding, quality=90)
    )
    assert codec is Codec.JPEG
    assert len(packed) < 0.3 * pixels.size
    raw = decode(codec, packed, max_bytes=CAP)
    after = ros_types.deserialise(raw, IMAGE, encoding)
    assert after.header == ros_types.header(STAMP_NS, "camera", encoding, 7)
    assert (after.height, after.width, after.encoding, after.step) == (120, 161, kind, 161 * channels)
    got = np.asarray(after.data).reshape(pixels.shape)
    assert np.abs(got.astype(int) - pixels).mean() < 3.0


# --- what is refused --------------------------------------------------------------------------------------------------


def test_what_a_lossy_mode_cannot_take_is_sent_as_it_is() -> None:
    depth = image_body(scene(40, 40, 2), "16UC1", Encoding.CDR)
    coder = Coder(max_bytes=CAP)
    assert coder.encode(Compression.JPEG, depth, image_topic(Encoding.CDR))[:2] == (Codec.NONE, depth)
    noise = Random(1).randbytes(3000)
    for topic in (cloud_topic(Encoding.ROS1), cloud_topic(Encoding.RAW)):
        assert coder.encode(Compression.VOXEL_DRACO, noise, topic)[:2] == (Codec.NONE, noise)
    wide = cloud_body(np.array([[0, 0, 0], [1e8, 0, 0]] * 30, np.float32), STAMP_NS, "map", Encoding.ROS1)
    assert coder.encode(Compression.VOXEL_DRACO, wide, cloud_topic(Encoding.ROS1)).codec is Codec.NONE
    assert coder.unencodable == 4


@pytest.mark.parametrize("mode", list(codecs.LOSSY))
def test_no_topic_is_lossy_unless_it_says_so(mode: Compression) -> None:
    body = cloud_body(room(100), STAMP_NS, "velodyne", Encoding.ROS1)
    with pytest.raises(CodecError, match="does not allow"):
        encode(mode, body)
    world = World(compress=True)
    channel = world.client("robot").publish("/robot/points", spec())
    with pytest.raises(UsageError, match="does not allow"):
        world.clients["robot"].core.set_compression(channel, mode, now=0.0)


@pytest.mark.parametrize("mode", list(codecs.LOSSY))
def test_an_absent_library_is_named_in_one_line(mode: Compression, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(lossy, "find_spec", lambda name: None if name in ("DracoPy", "PIL") else found(name))
    problem = lossy.missing(mode)
    assert problem is not None and "pip install " in problem and "\n" not in problem
    body = cloud_body(room(100), STAMP_NS, "velodyne", Encoding.ROS1)
    topic = LossyTopic(tuple(codecs.LOSSY), Encoding.ROS1, LossyParams())
    with pytest.raises(CodecError, match="pip install"):
        encode(mode, body, topic)


GOOD_CLOUD = encode(
    Compression.VOXEL_DRACO, cloud_body(room(300), STAMP_NS, "v", Encoding.CDR), cloud_topic(Encoding.CDR)
)[1]
GOOD_IMAGE = encode(Compression.JPEG, image_body(scene(64, 64, 3), "rgb8", Encoding.ROS1), image_topic(Encoding.ROS1))[
    1
]


@st.composite
def mutated(draw: st.DrawFn) -> tuple[Codec, bytes]:
    codec, good = draw(st.sampled_from([(Codec.DRACO, GOOD_CLOUD), (Codec.JPEG, GOOD_IMAGE)]))
    data = bytearray(good)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data) - 1))
        match draw(st.integers(0, 2)):
            case 0:
                data[at] = draw(st.sampled_from([0, 1, 0x7F, 0xFF]) | st.integers(0, 255))
            case 1:
                del data[at : at + draw(st.integers(1, 8))]
                data += b"\0"
            case _:
                data[at:at] = draw(st.binary(max_size=8))
    return codec, bytes(data)


@given(case=mutated() | st.tuples(st.sampled_from([Codec.DRACO, Codec.JPEG]), st.binary(max_size=300)))
@settings(STEADY, max_examples=cases(250))
def test_any_bytes_decode_to_what_they_claim_or_raise_codec_error(case: tuple[Codec, bytes]) -> None:
    codec, body = case
    try:
        raw = decode(codec, body, max_bytes=1 << 20)
    except CodecError:
        return
    assert len(raw) == codecs.raw_size(codec, body) <= 1 << 20


def test_a_lossy_bomb_is_refused_within_the_cap() -> None:
    """A tiny JPEG that says it is huge, and a Draco buffer of a thousand million points."""
    at = GOOD_IMAGE.index(b"\xff\xc0") + 5
    huge = bytearray(GOOD_IMAGE)
    huge[at : at + 4] = struct.pack("!HH", 65_000, 65_000)
    at = GOOD_CLOUD.index(b"DRACO") + lossy.DRACO_NUM_POINTS_AT
    many = bytearray(GOOD_CLOUD)
    many[at : at + 4] = struct.pack("<I", 10**9)
    claimed = bytearray(many)
    claimed[:4] = SIZE.pack((1 << 20) - 1)
    tracemalloc.start()
    try:
        for codec, body in ((Codec.JPEG, huge), (Codec.DRACO, many), (Codec.DRACO, claimed)):
            with pytest.raises(CodecError):
                decode(codec, bytes(body), max_bytes=1 << 20)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


# --- through the link -------------------------------------------------------------------------------------------------


def test_auto_takes_a_lossy_mode_where_it_may() -> None:
    world = World(compress=True).watch()
    thin = LinkModel(rate_bps=1e6, delay_s=0.02).as_stream()
    robot, site = world.client("robot", thin), world.client("site", patterns=["/robot/.*"])
    body = cloud_body(room(5000), STAMP_NS, "velodyne", Encoding.CDR)
    options: dict[str, Any] = {"lossy": tuple(codecs.LOSSY), "lossy_params": LossyParams(voxel_m=0.5)}
    may = robot.publish("/robot/may", spec(PriorityClass.BULK, **options), type_name="sensor_msgs/msg/PointCloud2")
    not_ = robot.publish("/robot/not", spec(PriorityClass.BULK), type_name="sensor_msgs/msg/PointCloud2")
    text = robot.publish("/robot/text", spec(PriorityClass.BULK, **options))
    for channel in (may, not_, text):
        robot.every(0.2, channel, body)
    world.run(10.0)
    assert may.codec is not None and may.codec.mode is Compression.VOXEL_DRACO
    assert may.codec.ratio < 0.2
    assert set(may.codec.profiles) == {*codecs.LOSSLESS[1:], Compression.VOXEL_DRACO}
    for channel in (not_, text):
        assert channel.codec is not None and channel.codec.mode in codecs.LOSSLESS
    assert all(got.body == body for topic in ("/robot/not", "/robot/text") for got in site.on(topic))
    latest = read_cloud(site.on("/robot/may")[-1].body, Encoding.CDR)
    assert 0 < len(latest.points) < 5000
