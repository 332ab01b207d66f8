"""Disks in virtual time: what was committed outlives its process, what was not is gone with it."""

from collections.abc import Sequence
from copy import deepcopy

from sern_client.durable import DurableTopics
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import StreamId, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_relay.durable import DurableHolding
from sern_runtime.durable.disk import Disk
from sern_runtime.durable.keeper import Stored
from sern_runtime.durable.store import (
    ROW_BYTES,
    Change,
    Contents,
    Described,
    Forget,
    KeptStream,
    Place,
    Put,
    Trim,
)
from tests.world import SimClient, World


class SimDisk:
    """One machine's disk. `commit_s`: how long a commit takes; `full`: it takes nothing."""

    def __init__(self, *, commit_s: float = 0.02) -> None:
        self.commit_s = commit_s
        self.full = False
        self.contents: Contents | None = None
        self.process = 0

    def open(self, *, new_boot: int) -> Contents:
        if self.contents is None:
            self.contents = Contents(new_boot, {})
        self.process += 1
        return deepcopy(self.contents)

    def close(self) -> None: ...

    def apply(self, changes: Sequence[Change]) -> None:
        assert self.contents is not None
        streams = self.contents.streams
        for change in changes:
            match change:
                case Described(stream, announcement, definition, required, last):
                    known = streams.setdefault(stream, KeptStream(stream, announcement, definition, required, last))
                    known.announcement, known.definition = announcement, definition
                    known.required, known.last = required, max(last, known.last)
                case Put(stream, row):
                    streams[stream].rows.append(row)
                    streams[stream].last = max(streams[stream].last, row.seq)
                case Trim(stream, upto):
                    if stream in streams:
                        streams[stream].rows = [row for row in streams[stream].rows if row.seq > upto]
                case Place(stream, client, seq):
                    if stream in streams:
                        streams[stream].places[client] = seq
                case Forget(stream):
                    streams.pop(stream, None)


class SimKeeper:
    """The `Keeper` of one process. What it has not committed when another opens the disk is lost."""

    def __init__(self, world: World, disk: SimDisk, stored: Stored, *, max_bytes: int = 2**30) -> None:
        self.kept_bytes = 0
        self.problem: str | None = None
        self.messages = self.commits = self.failures = 0
        self._world = world
        self._disk = disk
        self._stored = stored
        self._max_bytes = max_bytes
        self._mine = disk.process
        self._changes: list[Change] = []
        self._busy = False

    def start(self) -> None: ...

    def has_room(self, origin: ClientName, size_bytes: int) -> bool:
        return self.kept_bytes + size_bytes + ROW_BYTES <= self._max_bytes

    def found(self, stream: StreamId, seq: int, size_bytes: int) -> None: ...

    def put(self, change: Put) -> None:
        self.change(change)

    def trim(self, stream: StreamId, upto: int) -> None:
        self.change(Trim(stream, upto))

    def forget(self, stream: StreamId) -> None:
        self.change(Forget(stream))

    def progress(self, *, now: float) -> int:
        return int(now * 1e3)

    def change(self, change: Change) -> None:
        self._changes.append(change)
        if not self._busy:
            self._busy = True
            self._world.network.after(self._disk.commit_s, self._commit)

    def _commit(self, _now: float) -> None:
        self._busy = False
        if self._mine != self._disk.process:
            return
        if self._disk.full:
            self._busy = True
            self._world.network.after(self._disk.commit_s, self._commit)
            return
        changes, self._changes = self._changes, []
        self._disk.apply(changes)
        self._stored([change for change in changes if isinstance(change, Put)])

    def close(self) -> None: ...


class DurableRobot:
    """A client with a disk and one durable topic. `stored` are the bodies that were acknowledged to the publisher, by
    number; a body is its number, which goes on over all processes."""

    def __init__(self, world: World, client: SimClient, disk: SimDisk, topic: str, spec: TopicSpec) -> None:
        self.world = world
        self.disk = disk
        self.info = TopicInfo(TopicName(topic), "std_msgs/msg/String", Encoding.CDR, "RIHS01_0", "string data")
        self.spec = spec
        self.offered = 0
        self.acknowledged: set[int] = set()
        self.client = client
        self.begin(client)

    def begin(self, client: SimClient) -> None:
        """Another process has begun."""
        self.client = client
        network = self.world.network
        self.topics = DurableTopics(
            Disk(self.disk, lambda stored: SimKeeper(self.world, self.disk, stored)),
            core=client.core,
            now=lambda: client.now,
            wall_ns=lambda: 10**18 + int(network.now * 1e9),
        )
        self.topics.start(lambda _info: self.spec)
        self.channel: OutChannel = self.topics.publish(self.info, self.spec)
        self._waiting: list[int] = []
        send = self.topics.sender(self.channel, self._send, lambda _count: None)
        self._keep = send

    def _send(self, body: bytes, stamp_ns: int, born_s: float | None) -> bool:
        client = self.client
        self.acknowledged.add(int(body))
        return client.core.send(self.channel, body, stamp_ns, born_s=born_s, now=client.now, forced=True)

    def offer(self) -> None:
        self.offered += 1
        self._keep(b"%d" % self.offered, 0, None)

    def look(self, _now: float) -> None:
        self.topics.look()


class DurableRelay:
    """The relay of a world, and its disk."""

    def __init__(self, world: World, disk: SimDisk) -> None:
        self.world = world
        self.disk = disk
        self.begin()

    def begin(self) -> None:
        """Another process has begun."""
        network, relay = self.world.network, self.world.relay
        self.holding = DurableHolding(
            Disk(self.disk, lambda stored: SimKeeper(self.world, self.disk, stored)),
            relay.hub,
            known=lambda _client: True,
            now=lambda: relay.now,
            after=lambda: None,
            wall_ns=lambda: 10**18 + int(network.now * 1e9),
        )
        self.holding.start()
