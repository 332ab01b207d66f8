"""Random changes of sessions and streams in front of an endpoint: relay, robot and site as cores in this process, with
the site's real bridge between its core and the endpoint under test.

Nothing is on a network: datagrams are handed over at once, or kept back for a while, as the seed says.
"""

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Final

from sern_client.endpoints.base import Endpoint
from sern_client.tables import Tables
from sern_core.relay.hub import Hub
from sern_core.relay.hub_port import HubPort
from sern_core.site.client import ClientCore
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, Encoding
from sern_runtime import ros_types
from tests.bridges import Shell, bridge_of
from tests.support import until
from tests.world import OPEN_ACCESS, spec

TOPICS: Final = tuple(f"/robot/t{number}" for number in range(4))
TYPES: Final = ("std_msgs/msg/String", "std_msgs/msg/Int32")
STEPS: Final = 40
LINK: Final = LinkParams(retention_s=1.0)
"""A stream that a new relay does not know is kept for so long, in case it learns of it."""


class Ignored:
    """`ClientEvents` and `HubEvents` of those who are only there to make something happen."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_args, **_kwargs: None


class Client:
    """A process of one client: a core and its connection."""

    def __init__(self, changes: "Changes", core: ClientCore, *patterns: str) -> None:
        self._changes = changes
        self.core = core
        self.core.subscribe(patterns, now=time.monotonic())
        self.port: HubPort | None = None

    def connect(self) -> None:
        """On a connection of its own, as a socket that has just been opened."""
        self.disconnect()
        self.port = HubPort(self._changes.hub, self.core.name)
        self.core.link.connected(now=time.monotonic())

    def disconnect(self) -> None:
        port, self.port = self.port, None
        if port is not None:
            port.disconnected(now=time.monotonic())
            self.core.link.disconnected(now=time.monotonic())

    def exchange(self) -> bool:
        """Hand one datagram over each way; False: there is none."""
        now = time.monotonic()
        moved = False
        if self.port is not None:
            for here, there in ((self.core.link, self.port), (self.port, self.core.link)):
                here.handle_timeout(now=now)
                data = here.next_datagram(now=now)
                if data is not None:
                    moved = True
                    there.receive(data, now=now)
        return moved


class Changes:
    """`run` makes random changes, and then lets all come to rest; `wanted` is what the robot publishes then."""

    def __init__(self, endpoint: Endpoint, seed: int, *, encoding: Encoding) -> None:
        self.random = Random(seed)
        self.endpoint = endpoint
        self.encoding = encoding
        self.hub = self._new_hub()
        self.shell = Shell()
        boot = self.random.getrandbits(62)
        self.bridge = bridge_of(endpoint, shell=self.shell, link=LINK, boot=boot, now=time.monotonic())
        self.tables = Tables(self.bridge)
        self.site = Client(self, self.bridge.core, "/robot/.*")
        self.robot = Client(self, self._other("robot"))
        self.rival: Client | None = None
        self.channels: dict[str, OutChannel] = {}

    @property
    def wanted(self) -> dict[str, TopicInfo]:
        return {name: channel.stream.info for name, channel in self.channels.items()}

    def _other(self, name: str) -> ClientCore:
        """The core of a process that is only there to make something happen."""
        return ClientCore(
            name=ClientName(name), boot=self.random.getrandbits(62), events=Ignored(), link=LINK,
            scheduler=SchedulerParams(), now=time.monotonic(),
        )  # fmt: skip

    def _new_hub(self) -> Hub:
        return Hub(
            name=ClientName("relay"), boot=self.random.getrandbits(62), access=OPEN_ACCESS, known=lambda _name: True,
            events=Ignored(), link=LINK, scheduler=SchedulerParams(), wall_ns=lambda now: int(now * 1e9),
            now=time.monotonic(),
        )  # fmt: skip

    # What may happen

    def _clients(self) -> list[Client]:
        return [each for each in (self.robot, self.site, self.rival) if each is not None]

    def _stream(self) -> None:
        """A topic of the robot ends, begins, or begins anew with the same or another type."""
        name = self.random.choice(TOPICS)
        channel = self.channels.pop(name, None)
        now = time.monotonic()
        if channel is not None:
            self.robot.core.unpublish(channel, now=now)
        if channel is None or self.random.random() < 0.7:
            latched = self.random.random() < 0.3
            info = replace(
                ros_types.topic_info(name, self.random.choice(TYPES), self.encoding), latched=latched, reliable=True
            )
            reliable = self.random.random() < 0.5
            self.channels[name] = self.robot.core.publish(info, spec(reliable=reliable, latched=latched), now=now)

    def _message(self) -> None:
        body = bytes(4) if self.encoding is Encoding.ROS1 else b"\x00\x01\x00\x00\x01\x00\x00\x00\x00"  # of either type
        for channel in self.channels.values():
            self.robot.core.send(channel, body, 0, now=time.monotonic())

    def _reconnect(self) -> None:
        self.random.choice(self._clients()).connect()

    def _rival(self) -> None:
        """Another process of the site's name comes, with other wishes, or goes."""
        if self.rival is None:
            self.rival = Client(self, self._other("site"), "/robot/nosuch")
            self.rival.connect()
        else:
            self.rival.disconnect()
            self.rival = None

    def _robot_restarts(self) -> None:
        names, self.channels = list(self.channels), {}
        self.robot.disconnect()
        self.robot = Client(self, self._other("robot"))
        for name in names:
            self._publish_again(name)
        self.robot.connect()

    def _publish_again(self, name: str) -> None:
        info = ros_types.topic_info(name, self.random.choice(TYPES), self.encoding)
        self.channels[name] = self.robot.core.publish(info, spec(), now=time.monotonic())

    def _relay_restarts(self) -> None:
        for client in self._clients():
            client.disconnect()
        self.hub = self._new_hub()
        for client in self._clients():
            client.connect()

    async def run(self) -> None:
        steps = [
            *[self._stream] * 6, *[self._message] * 2, *[self._reconnect] * 3, *[self._rival] * 4,
            self._robot_restarts, self._relay_restarts,
        ]  # fmt: skip
        for client in self._clients():
            client.connect()
        for _ in range(STEPS):
            self.random.choice(steps)()
            for _ in range(self.random.choice((0, 1, 5, 50))):
                self.random.choice(self._clients()).exchange()
            for _ in range(self.random.choice((0, 0, 1, 3))):
                await asyncio.sleep(0)
            if self.random.random() < 0.15:
                await asyncio.sleep(0.03)  # long enough for a fast poll of the middleware
        if self.rival is not None:
            self._rival()
        self.site.connect()
        assert self.shell.faults == []

    def settle(self) -> bool:
        """Exchange what there is; True once nothing moves."""
        self.hub.sweep(now=time.monotonic())
        moved = [client.exchange() for client in self._clients()]
        return not any(moved)

    async def at_rest(self, *, deadline_s: float = 20.0) -> None:
        """All sessions are there, nobody has anything to say, and every table agrees with every other."""

        def rests() -> bool:
            return (
                self.settle()
                and all(client.core.link.established for client in self._clients())
                and set(self.site.core.opened) == {channel.stream.id for channel in self.channels.values()}
                and self.tables.validate() == []
            )

        try:
            await until(rests, deadline_s=deadline_s)
        except AssertionError:
            raise AssertionError(
                f"wanted {sorted(self.wanted)}, open {sorted(self.site.core.opened)}, refused "
                f"{sorted(self.site.core.refused)}, differences: {list(map(str, self.tables.validate()))}"
            ) from None

    def close(self) -> None:
        self.bridge.close()
