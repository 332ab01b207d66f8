"""What the endpoint tests share: an event recorder, a polling wait, a virtual clock, and small recordings."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests import support
from tests.support import Events

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
DATA = Path(__file__).resolve().parents[3] / "../shared/data"


class VirtualClock:
    """Time that only `sleep` moves; every sleep gives the loop one turn."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic_s(self) -> float:
        return self.now_s

    def wall_ns(self) -> int:
        return START_NS + round(self.now_s * 1e9)

    async def sleep(self, delay_s: float) -> None:
        self.now_s += delay_s
        await asyncio.sleep(0)


@pytest.fixture
def until() -> Callable[[Callable[[], object]], Awaitable[None]]:
    """Poll a condition with a generous deadline."""
    return support.until


@pytest.fixture
def events() -> Events:
    return Events()


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def data() -> Callable[[str], Path]:
    """A file of the real recordings, or a skip."""

    def find(name: str) -> Path:
        path = DATA / name
        if not path.exists():
            pytest.skip(f"real recording {name} is not beside this checkout")
        return path

    return find


def _qos(durability: QosDurability, reliability: QosReliability) -> Qos:
    zero = QosTime(0, 0)
    return Qos(QosHistory.KEEP_LAST, 10, reliability, durability, zero, zero, QosLiveliness.AUTOMATIC, zero, False)


def text(number: int, encoding: Encoding) -> bytes:
    """A std_msgs/String body with a number in it."""
    name = "std_msgs/msg/String"
    return ros_types.serialise(ros_types.new(name, encoding, data=f"message {number}"), name, encoding)


@pytest.fixture
def make_bag(tmp_path: Path) -> Callable[..., Path]:
    """`make_bag(kind, count)`: a recording of kind bag, db3 or mcap.

    /chat std_msgs/String every 10 ms, reliable; /scan_text the same halfway between, best effort; /tf_static and /map
    (latched) once at the start.
    """

    def make(kind: str = "bag", count: int = 10, name: str = "run") -> Path:
        string, tf = "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"
        encoding = Encoding.ROS1 if kind == "bag" else Encoding.CDR
        store = ros_types.typestore(encoding)
        tf_body = ros_types.serialise(ros_types.new(tf, encoding), tf, encoding)
        schedule = [("/tf_static", 0, tf_body), ("/map", 0, text(-1, encoding))]
        for i in range(count):
            schedule.append(("/chat", i * STEP_NS, text(i, encoding)))
            schedule.append(("/scan_text", i * STEP_NS + STEP_NS // 2, text(1000 + i, encoding)))
        if kind == "bag":
            path = tmp_path / f"{name}.bag"
            with Writer1(path) as writer:
                writer.chunk_threshold = 2000
                ids = {
                    topic: writer.add_connection(
                        topic, tf if topic == "/tf_static" else string, typestore=store, latching=latching
                    )
                    for topic, latching in (("/chat", None), ("/scan_text", 0), ("/tf_static", 1), ("/map", 1))
                }
                for topic, offset_ns, body in schedule:
                    writer.write(ids[topic], START_NS + offset_ns, body)
            return path
        folder = tmp_path / name
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        keep, forget = QosDurability.TRANSIENT_LOCAL, QosDurability.VOLATILE
        sure, unsure = QosReliability.RELIABLE, QosReliability.BEST_EFFORT
        with Writer2(folder, version=9, storage_plugin=plugin) as writer2:
            profiles = {
                "/chat": _qos(forget, sure),
                "/scan_text": _qos(forget, unsure),
                "/tf_static": _qos(keep, sure),
                "/map": _qos(keep, sure),
            }
            ids = {
                topic: writer2.add_connection(
                    topic,
                    tf if topic == "/tf_static" else string,
                    typestore=store,
                    offered_qos_profiles=[profile],
                )
                for topic, profile in profiles.items()
            }
            for topic, offset_ns, body in schedule:
                writer2.write(ids[topic], START_NS + offset_ns, body)
        return next(folder.glob("*.mcap")) if kind == "mcap" else folder

    return make
