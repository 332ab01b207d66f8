"""ROS 2 through rclpy, where a ROS 2 installation is sourced: bytes pass through as CDR, whatever its middleware is.

Thin on purpose, and topics only: `dds` and `zenoh` need no installation and know services. Checked against a typed
stub of rclpy's interface (`stubs/rclpy`) and a stand-in in the tests, not against an installation.
"""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Final

from sern_client.endpoints.base import GUARD_SUFFIX, Difference, Held, Sink, TopicEvents
from sern_client.endpoints.common.handover import Handover
from sern_client.endpoints.common.interest import OnDemand, Subscriptions
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.common.stream import Stream, Streams
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.entry import end_tasks
from sern_runtime.ros_files import TypeFiles

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher as RosPublisher
    from rclpy.qos import QoSProfile

DEPTH: Final = 100
"""The depth of our subscriptions: what may wait while the executor's thread is behind."""
LATCHED_DEPTH: Final = 10

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RclpyOptions:
    """`domain` None: ROS_DOMAIN_ID of the environment. `poll_hz`: how often the graph is asked what there is."""

    node_name: str = "sern"
    domain: int | None = None
    poll_hz: float = 4.0
    type_paths: tuple[Path, ...] = ()


class RclpyEndpoint:
    """An `Endpoint`. Its node spins in a thread of its own; `start` raises ConfigError where rclpy is not to be had."""

    def __init__(self, options: RclpyOptions) -> None:
        self.options = options
        self.types = TypeFiles(options.type_paths)
        self._say_once = SayOnce(_log)
        self._subscriptions: Subscriptions[OnDemand] = Subscriptions(self._say_once)
        self._announced: dict[TopicName, TopicInfo] = {}
        self._streams: Streams[_Writer] = Streams()
        self._handover: Handover | None = None

    @property
    def encoding(self) -> Encoding | None:
        return Encoding.CDR

    @property
    def exhausted(self) -> bool:
        return False

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages dropped because the event loop was behind, or nobody can be reached any more."""
        behind = 0 if self._handover is None else self._handover.dropped
        return Counter({DropReason.QUEUE_FULL: behind}) + self._streams.dropped

    async def start(self, events: TopicEvents) -> None:
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.node import Node
        except ImportError:
            raise ConfigError(
                "endpoint rclpy needs a sourced ROS 2 installation (rclpy is not there); kinds dds and zenoh need none"
            ) from None
        self._events = events
        self._handover = Handover(asyncio.get_running_loop())
        self._context: Context = Context()
        rclpy.init(args=[], context=self._context, domain_id=self.options.domain)
        self._node: Node = Node(
            self.options.node_name, context=self._context, enable_rosout=False, start_parameter_services=False
        )
        self._executor: SingleThreadedExecutor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = Thread(target=self._spin, name="rclpy", daemon=True)
        self._thread.start()
        self._poll()
        self._task = asyncio.create_task(self._watch(), name="rclpy-graph")

    async def stop(self) -> None:
        await end_tasks([self._task])
        self._subscriptions.close()
        import rclpy

        self._executor.shutdown()
        rclpy.shutdown(context=self._context)
        await asyncio.to_thread(self._thread.join)
        if self._handover is not None:
            self._handover.close()
        self._node.destroy_node()

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Nobody wants it: the node has no subscription of it, unless the topic is latched."""
        self._subscriptions.interest(name, wanted)

    def subscribe(self, name: TopicName, sink: Sink) -> OnDemand:
        info = self._announced.get(name)
        if info is None:
            raise UsageError(f"{name}: no such topic was announced")
        return self._subscriptions.add(OnDemand(info, sink, self._receive, self._subscriptions.remove))

    def advertise(self, info: TopicInfo) -> "Stream[_Writer]":
        message_type = self._message_type(info.name, info.type_name)
        profile = _profile(reliable=info.reliable is not False, latched=info.latched, depth=LATCHED_DEPTH)
        writer = _Writer(self._node, self._node.create_publisher(message_type, info.name, profile))
        return self._streams.open(info.name, writer, None)

    def validate(self, held: Held) -> list[Difference]:
        """Without the thread that spins nothing is received: that is a difference of every topic."""
        found = held.differences(Held(self._streams.names, self._subscriptions.names))
        found += self._subscriptions.differences()
        if not self._thread.is_alive():
            found.append(Difference(TopicName(""), "the thread of rclpy has ended; start the client again"))
        if self._task.done():
            found.append(Difference(TopicName(""), "nobody looks at the graph any more; start the client again"))
        return found

    def _receive(self, info: TopicInfo, arrived: Callable[[bytes, int], None]) -> Callable[[], None]:
        node, handover = self._node, self._handover
        assert handover is not None, "a topic was announced, so we were started"

        def came(body: bytes) -> None:  # in the thread that spins
            stamp_ns = time.time_ns()
            handover.put(lambda: arrived(body, stamp_ns), len(body))

        message_type = self._message_type(info.name, info.type_name)
        opened = node.create_subscription(message_type, info.name, came, self._qos(info.name), raw=True)

        def end() -> None:
            node.destroy_subscription(opened)

        return end

    def _message_type(self, name: TopicName, type_name: str) -> type[object]:
        from rosidl_runtime_py.utilities import get_message

        try:
            return get_message(ros_types.canonical(type_name))
        except (ModuleNotFoundError, AttributeError, ValueError) as error:
            raise ConfigError(
                f"{name}: {type_name} is not in this ROS 2 installation ({ros_types.one_line(error)}); "
                "source the workspace that has it"
            ) from None

    def _qos(self, name: TopicName) -> "QoSProfile":
        """What fits all publishers there are: reliable and latched only if each of them is."""
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

        offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(name)]
        return _profile(
            reliable=bool(offers) and all(offer.reliability is ReliabilityPolicy.RELIABLE for offer in offers),
            latched=bool(offers) and all(offer.durability is DurabilityPolicy.TRANSIENT_LOCAL for offer in offers),
            depth=DEPTH,
        )

    # --- the graph --------------------------------------------------------------------------------------------------

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        try:
            self._executor.spin()
        except ExternalShutdownException:
            _log.debug("the context of rclpy was shut down")

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(1 / self.options.poll_hz)
            try:
                self._poll()
            except Exception as error:  # noqa: BLE001  (of this look; the next may succeed)
                self._say_once(f"the graph could not be looked at: {ros_types.one_line(error)}", error=error)

    def _poll(self) -> None:
        """Announce what appeared, retract what went. A topic that cannot be looked at stays as it was."""
        found: set[TopicName] = set()
        for text, type_names in self._node.get_topic_names_and_types():
            name = TopicName(text)
            try:
                there = self._look_at(name, type_names)
            except Exception as error:  # noqa: BLE001  (a fault of one topic)
                self._say_once(f"{name} could not be looked at: {ros_types.one_line(error)}", error=error)
                there = True
            if there:
                found.add(name)
        for name in [name for name in self._announced if name not in found]:
            del self._announced[name]
            self._events.topic_removed(name)

    def _look_at(self, name: TopicName, type_names: list[str]) -> bool:
        """Announce a topic if it is new. False: it is not there, as far as others are concerned; one that only we
        publish is not."""
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

        own, namespace = self._node.get_name(), self._node.get_namespace()
        ours = {(own, namespace), (own + GUARD_SUFFIX, namespace)}
        publishers = [
            info
            for info in self._node.get_publishers_info_by_topic(name)
            if (info.node_name, info.node_namespace) not in ours
        ]
        if not publishers:
            return False
        if len(type_names) > 1:
            self._say_once(f"{name} is published with several types ({', '.join(type_names)}); left out")
            return False
        known = self._announced.get(name)
        if known is not None and known.type_name == type_names[0]:
            return True
        if known is not None:  # with another type: that is another topic
            del self._announced[name]
            self._events.topic_removed(name)
        try:
            self._message_type(name, type_names[0])
        except ConfigError as error:
            self._say_once(f"{error}; left out")
            return True
        first = publishers[0].qos_profile
        info = self._info(
            name,
            type_names[0],
            latched=first.durability is DurabilityPolicy.TRANSIENT_LOCAL,
            reliable=first.reliability is ReliabilityPolicy.RELIABLE,
        )
        self._announced[name] = info
        self._events.topic_added(info)
        return True

    def _info(self, name: TopicName, type_name: str, *, latched: bool, reliable: bool) -> TopicInfo:
        definition = type_hash = ""
        try:
            definition = self.types.message(type_name) or ""
            if definition:
                type_hash = ros_types.hash_of(type_name, definition, Encoding.CDR)
            else:
                self._say_once(f"{type_name}: its definition is not known; add the directory of its file to type_paths")
        except ConfigError as error:
            self._say_once(str(error))
        return TopicInfo(name, type_name, Encoding.CDR, type_hash, definition, latched, reliable)


class _Writer:
    def __init__(self, node: "Node", publisher: "RosPublisher") -> None:
        self._node = node
        self._publisher = publisher

    def publish(self, body: bytes, stamp_ns: int) -> None:
        del stamp_ns  # rclpy stamps what it publishes itself
        self._publisher.publish(body)

    def close(self) -> None:
        self._node.destroy_publisher(self._publisher)


def _profile(*, reliable: bool, latched: bool, depth: int) -> "QoSProfile":
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
