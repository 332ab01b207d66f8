"""A ROS graph in memory for a node: topics that a test publishes, topics and services that the node has."""

from collections.abc import Callable
from typing import Any

from sern_client.endpoints.base import ServiceHandler, ServiceInfo, Sink, TopicEvents
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types

CDR = Encoding.CDR


class Closing:
    def __init__(self, close: Callable[[], object]) -> None:
        self._close = close

    def close(self) -> None:
        self._close()


class Publishing(Closing):
    def __init__(self, info: TopicInfo, said: list[Any], close: Callable[[], object]) -> None:
        super().__init__(close)
        self._info = info
        self._said = said

    def publish(self, body: bytes, stamp_ns: int) -> None:
        del stamp_ns
        self._said.append(ros_types.deserialise(body, self._info.type_name, self._info.encoding))


class Graph:
    """`said`: what the node published, by topic, as messages."""

    def __init__(self) -> None:
        self.said: dict[str, list[Any]] = {}
        self.sinks: dict[TopicName, Sink] = {}
        self.handlers: dict[str, ServiceHandler] = {}
        self.open: set[str] = set()

    @property
    def endpoint(self) -> Any:
        """The graph as the endpoint of a node, of which it has what a node uses."""
        return self

    def subscribe(self, name: TopicName, sink: Sink) -> Closing:
        self.sinks[name] = sink
        return Closing(lambda: self.sinks.pop(name, None))

    def advertise(self, info: TopicInfo) -> Any:
        self.open.add(info.name)
        if "/_action/" in info.name:
            return Raw(self.said.setdefault(info.name, []), lambda: self.open.discard(info.name))
        return Publishing(info, self.said.setdefault(info.name, []), lambda: self.open.discard(info.name))

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> Closing:
        self.handlers[info.name.rpartition("/")[2]] = handler
        self.open.add(info.name)
        return Closing(lambda: self.open.discard(info.name))

    def announce(self, events: TopicEvents, name: str, type_name: str, encoding: Encoding = CDR) -> None:
        events.topic_added(ros_types.topic_info(name, type_name, encoding))

    def give(self, name: str, body: bytes) -> bool:
        return self.sinks[TopicName(name)](body, 0)

    def last(self, name: str) -> Any:
        return self.said[name][-1]


class Raw(Closing):
    """Bodies as they are: of parts of actions."""

    def __init__(self, said: list[Any], close: Callable[[], object]) -> None:
        super().__init__(close)
        self._said = said

    def publish(self, body: bytes, stamp_ns: int) -> None:
        del stamp_ns
        self._said.append(body)
