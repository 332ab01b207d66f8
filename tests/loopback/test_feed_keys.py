"""The feed with keys: libzmq's box around a message, and its note of who the user is, take room as well."""

from collections.abc import AsyncIterator

import pytest
import zmq
from zmq.utils.monitor import parse_monitor_message

from sern_core.types import TopicName
from sern_runtime.feed import MAX_SUBSCRIPTION_BYTES, MAX_TOPIC_BYTES, Feed, topic_frame
from sern_runtime.feed_subscriptions import ENTRY_BYTES
from sern_runtime.keys import SecretKey
from sern_runtime.zap import ZapHandler
from sern_runtime.zmq_socket import connect_curve
from tests.loopback.test_feed import HEADER, ODOM, role
from tests.support import until

Context = zmq.Context[zmq.Socket[bytes]]


class Keyed:
    """A feed with keys, and programs that have one."""

    def __init__(self, context: Context, relay_keys: SecretKey, keys: SecretKey) -> None:
        self.came_in: list[bytes] = []
        self._context = context
        self._relay_keys = relay_keys
        self._keys = keys
        self.sockets: list[zmq.Socket[bytes]] = []
        self._handler = ZapHandler(context)
        self._handler.add_domain("feed.viewer", lambda key, _address: {keys.public_key: "robot1"}.get(key))
        self.feed = Feed(
            context,
            [role(publish=".*")],
            on_publish=lambda _role, _name, _header, body: self.came_in.append(body),
            keys=relay_keys,
        )

    def socket(self, kind: int) -> "zmq.Socket[bytes]":
        """Of a program, not yet connected."""
        socket = self._context.socket(kind)
        self.sockets.append(socket)
        connect_curve(socket, self._keys, self._relay_keys.public_key)
        return socket

    def subscriber(self, *prefixes: bytes) -> "zmq.Socket[bytes]":
        socket = self.socket(zmq.SUB)
        for prefix in prefixes:
            socket.subscribe(prefix)
        socket.connect(self.feed.endpoints()["viewer"][0])
        return socket

    @property
    def prefixes(self) -> tuple[bytes, ...]:
        return self.feed.prefixes()["viewer"]

    def close(self) -> None:
        for socket in self.sockets:
            socket.close(linger=0)
        self.feed.close()
        self._handler.close()


@pytest.fixture
async def keyed(zmq_context: Context, relay_keys: SecretKey, robot_keys: SecretKey) -> AsyncIterator[Keyed]:
    keyed = Keyed(zmq_context, relay_keys, robot_keys)
    yield keyed
    keyed.close()


async def test_a_subscriber_is_served_what_it_asks_for_and_no_more(keyed: Keyed) -> None:
    names = [TopicName(f"/r/t{number}") for number in range(50)]
    frames = {topic_frame(name) for name in names}
    socket = keyed.subscriber(*frames)
    await until(lambda: set(keyed.prefixes) == frames, "all subscriptions come through")
    socket.subscribe(topic_frame(ODOM))
    for name in names:
        socket.unsubscribe(topic_frame(name))
    await until(lambda: keyed.prefixes == (topic_frame(ODOM),), "and those that follow")
    keyed.feed.publish(ODOM, HEADER, b"body")
    await until(lambda: socket.poll(0), "a message")
    assert socket.recv_multipart()[0] == topic_frame(ODOM)


async def test_the_longest_topic_can_be_subscribed_to_and_a_longer_prefix_ends_the_connection(keyed: Keyed) -> None:
    longest = TopicName("/" + "t" * (MAX_TOPIC_BYTES - 2))
    honest = keyed.subscriber(topic_frame(longest))
    await until(lambda: keyed.prefixes == (topic_frame(longest),), "the longest is taken")
    hostile = keyed.socket(zmq.SUB)
    monitor = hostile.get_monitor_socket()
    keyed.sockets.append(monitor)
    seen: list[int] = []

    def cut() -> bool:
        while monitor.poll(0):
            seen.append(parse_monitor_message(monitor.recv_multipart())["event"])
        return zmq.EVENT_DISCONNECTED in seen

    hostile.subscribe(b"x" * MAX_SUBSCRIPTION_BYTES)
    hostile.connect(keyed.feed.endpoints()["viewer"][0])
    await until(cut, "the longer one is cut")
    assert zmq.EVENT_HANDSHAKE_SUCCEEDED in seen
    assert keyed.prefixes == (topic_frame(longest),)
    keyed.feed.publish(longest, HEADER, b"body")
    await until(lambda: honest.poll(0), "the other one is served all the same")
    assert honest.recv_multipart()[0] == topic_frame(longest)


async def test_each_connection_counts_by_itself(keyed: Keyed) -> None:
    kept = keyed.feed._outlets["viewer"].subscriptions
    honest, other = keyed.subscriber(topic_frame(ODOM)), keyed.socket(zmq.XSUB)
    other.connect(keyed.feed.endpoints()["viewer"][0])
    other.send(b"\1" + topic_frame(ODOM))
    await until(lambda: len(kept._prefixes.get(topic_frame(ODOM), ())) == 2, "both subscribe")
    assert kept.total_bytes == 2 * (len(topic_frame(ODOM)) + ENTRY_BYTES)
    other.send(b"\0" + topic_frame(ODOM))
    await until(lambda: kept.total_bytes == len(topic_frame(ODOM)) + ENTRY_BYTES, "one unsubscribes")
    keyed.feed.publish(ODOM, HEADER, b"body")
    await until(lambda: honest.poll(0), "a message")
    honest.close(linger=0)
    await until(lambda: not keyed.prefixes, "ended")
    assert kept.total_bytes == 0


async def test_a_publisher_is_heard(keyed: Keyed) -> None:
    endpoint = keyed.feed.endpoints()["viewer"][1]
    assert endpoint is not None
    socket = keyed.socket(zmq.XPUB)
    socket.connect(endpoint)
    await until(lambda: socket.poll(0), "the feed subscribes")
    socket.send_multipart([topic_frame(ODOM), HEADER.pack(), b"body"])
    await until(lambda: keyed.came_in, "a message")
    assert keyed.came_in == [b"body"]
