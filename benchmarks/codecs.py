"""What each codec makes of real messages, and how fast: ratio, encoding and decoding by message type.

Drives of a Husky and a Jackal, LiDAR scans as sensor_msgs/PointCloud2, and, made here, an occupancy grid of rooms and
a colour image. The ratio is encoded by raw bytes, what gains less than 3 % counting as it is. Speeds are raw bytes a
second of CPU time in one thread; `one` is the time to encode one message.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from time import process_time
from typing import Final

import numpy as np
from rosbags.highlevel import AnyReader

from benchmarks.common import Report, main, pin_cpu
from benchmarks.recordings import DATA, DRIVE, SCANS
from sern_client.endpoints.clouds import cloud_body, read_ply
from sern_core.bodies import lossy
from sern_core.bodies.codecs import LOSSLESS, LOSSY, LossyTopic, decode, encode
from sern_core.bodies.lossy import IMAGE_TYPE
from sern_core.vocabulary.codec_names import DEFAULT_LOSSY, Codec, Compression
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types

BAGS: Final = {"husky": DRIVE, "jackal": "jackal_imu_odom.bag"}
MESSAGES: Final = 400
CAP_BYTES: Final = 64 << 20
BUDGET_S: Final = 0.4


def recorded() -> dict[str, tuple[str, list[bytes]]]:
    """Type and bodies by case; empty where there are no recordings."""
    cases: dict[str, tuple[str, list[bytes]]] = {}
    for robot, name in BAGS.items():
        if not (DATA / name).exists():
            continue
        with AnyReader([DATA / name]) as reader:
            for connection, _time_ns, body in reader.messages():
                label = f"{connection.msgtype.replace('/msg/', '/')} ({robot})"
                bodies = cases.setdefault(label, (connection.msgtype, []))[1]
                if len(bodies) < MESSAGES:
                    bodies.append(bytes(body))
    scans = [DATA / name for name in SCANS if (DATA / name).exists()]
    if scans:
        cases["sensor_msgs/PointCloud2 (LiDAR)"] = (
            lossy.CLOUD_TYPE,
            [cloud_body(read_ply(path), 0, "velodyne", Encoding.ROS1) for path in scans],
        )
    return cases


def made() -> dict[str, tuple[str, list[bytes]]]:
    """An occupancy grid of 500 x 500 cells with walls and speckle, and an image of 640 x 480 with sensor noise."""
    rng = np.random.default_rng(1)
    cells = np.full((500, 500), -1, np.int8)
    cells[50:450, 50:450] = 0
    cells[50:450:80, 50:450] = cells[50:450, 50:450:100] = 100
    speckle = rng.random(cells.shape) < 0.02
    cells[speckle] = rng.integers(0, 100, int(speckle.sum()))
    grid_type, image_type = "nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/Image"
    encoding = Encoding.ROS1
    header = ros_types.header(0, "map", encoding, 0)
    info = ros_types.new("nav_msgs/msg/MapMetaData", encoding)
    info.resolution, info.width, info.height = 0.05, 500, 500
    grid = ros_types.new(grid_type, encoding, header=header, info=info, data=cells.reshape(-1))
    y, x = np.mgrid[0:480, 0:640]
    layers = np.stack([127 + 100 * np.sin(x / (40 + 20 * c)) * np.cos(y / 60) for c in range(3)], axis=-1)
    pixels = np.clip(layers + rng.normal(0, 3, layers.shape), 0, 255).astype(np.uint8)
    image = ros_types.new(
        image_type,
        encoding,
        header=header,
        height=480,
        width=640,
        encoding="rgb8",
        is_bigendian=0,
        step=3 * 640,
        data=pixels.reshape(-1),
    )
    return {
        "nav_msgs/OccupancyGrid (made)": (grid_type, [ros_types.serialise(grid, grid_type, encoding)]),
        "sensor_msgs/Image rgb8 (made)": (IMAGE_TYPE, [ros_types.serialise(image, image_type, encoding)]),
    }


def seconds_each(work: Callable[[bytes], object], bodies: list[bytes], budget_s: float) -> float:
    """CPU seconds of `work` for one body, over all of them again and again."""
    rounds, start_s = 0, process_time()
    while True:
        for body in bodies:
            work(body)
        rounds += 1
        elapsed_s = process_time() - start_s
        if elapsed_s >= budget_s:
            return elapsed_s / (rounds * len(bodies))


def modes_of(type_name: str) -> list[Compression]:
    """The modes for messages of a type, as far as they are installed."""
    plain = type_name.replace("/msg/", "/", 1)
    return [*LOSSLESS[1:], *(mode for mode, wanted in LOSSY.items() if wanted == plain and not lossy.missing(mode))]


def run(options: argparse.Namespace, report: Report) -> None:
    report.note(pin_cpu())
    budget_s = BUDGET_S / 8 if options.quick else BUDGET_S
    cases = recorded()
    if not cases:
        report.note("no recordings beside the checkout: made messages only")
    for case, (type_name, bodies) in (cases | made()).items():
        size = sum(map(len, bodies)) / len(bodies)
        topic = LossyTopic(tuple(LOSSY), Encoding.ROS1, DEFAULT_LOSSY)
        for mode in modes_of(type_name):
            packed = [encode(mode, body, topic) for body in bodies]
            encode_s = seconds_each(partial(encode, mode, topic=topic), bodies, budget_s)
            ratio = sum(len(body) for _codec, body in packed) / (size * len(packed))
            figures = {"raw_B": size, "ratio_1": ratio, "encode_MB/s": size / encode_s / 1e6, "one_us": encode_s * 1e6}
            useful = [(codec, body) for codec, body in packed if codec is not Codec.NONE]
            if useful:
                work = partial(decode, useful[0][0], max_bytes=CAP_BYTES)
                decode_s = seconds_each(work, [body for _codec, body in useful], budget_s)
                figures["decode_MB/s"] = size / decode_s / 1e6
            report.row(case, str(mode), **figures)


if __name__ == "__main__":
    sys.exit(main("codecs", run, description=__doc__))
