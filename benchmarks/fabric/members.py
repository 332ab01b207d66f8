"""Many clients in one process: `python -m benchmarks.fabric.members SPEC` (JSON, the fields of `Members`).

Each is a client's core with the connections and keys of its own that its daemon would give it. The process says `ready`
when all are as they are to be measured, is told when to begin, and writes down what it saw when its input ends.
"""

import asyncio
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import uvloop
import zmq

from benchmarks.fleet import STAMP, Kind, looked_after, offer, topics_of
from benchmarks.link.load import POLL_S, Orders, ready
from benchmarks.loopback import Member
from sern_core.path.lanes import LANE_NAMES, LANE_UDP
from sern_core.vocabulary.message import Message, StreamId, StreamInfo
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_runtime import clock

ROBOT: Final = (
    Kind(PriorityClass.CONTROL, 1, 100, 10.0),
    Kind(PriorityClass.STATE, 1, 300, 2.0, reliable=True),
    Kind(PriorityClass.STATE, 1, 300, 1.0),
    Kind(PriorityClass.BULK, 1, 1000, 1.0),
)
"""What a robot sends: 14 messages a second."""
UDP: Final = LANE_NAMES[LANE_UDP]


@dataclass(frozen=True)
class Members:
    """`name` of the process; its clients by name: the relay of each, and what it subscribes to. Without any patterns
    they are robots, and offer what `ROBOT` says. `endpoints`: addresses of the relays. `opened`: so many streams come
    to them."""

    name: str
    directory: str
    endpoints: dict[str, str]
    clients: dict[str, tuple[str, list[str]]]
    opened: int = 0

    @property
    def folder(self) -> Path:
        return Path(self.directory)


class Site(Member):
    """Notes how old each message is when it comes: rows of when it was offered, its class, whose, and its age."""

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", spec: Members, name: str) -> None:
        relay, patterns = spec.clients[name]
        super().__init__(context, spec.folder, spec.endpoints[relay], ClientName(name), udp=True, relay=relay)
        self.opened = 0
        self.rows: list[tuple[float, int, bool, float]] = []
        self.last: dict[StreamId, int] = {}
        """The seq of the latest message of each reliable stream."""
        self.lost = 0
        self.doubled = 0
        self._near = f"{relay}_"
        self.core.subscribe(tuple(patterns), now=clock.now())

    def stream_opened(self, stream: StreamInfo) -> None:
        self.opened += 1

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        (sent_s,) = STAMP.unpack_from(message.body)
        crosses = not stream.id.origin.startswith(self._near)
        self.rows.append((sent_s, stream.spec.priority, crosses, clock.now() - sent_s))
        if stream.spec.reliable:
            last = self.last.get(stream.id, message.seq - 1)
            self.lost += max(0, message.seq - last - 1)
            self.doubled += message.seq <= last
            self.last[stream.id] = max(last, message.seq)


async def _robots(spec: Members, orders: Orders, context: "zmq.Context[zmq.Socket[bytes]]") -> None:
    members = [
        Member(context, spec.folder, spec.endpoints[relay], ClientName(name), udp=True, relay=relay)
        for name, (relay, _) in spec.clients.items()
    ]
    said = False

    def stopped() -> bool:
        nonlocal said
        orders.poll()
        if not said and all(member.lane == UDP for member in members):
            said = True
            ready()
        return orders.stopped

    async with looked_after(members, lambda: None):
        channels = await offer(members, ROBOT, len(members), stopped)
        while any(channel.retained for channel in channels):  # noqa: ASYNC110  (the core has no event for it)
            await asyncio.sleep(POLL_S)
    last = {f"{each.stream.id.origin} {each.stream.id.topic}": each.next_seq - 1 for each in channels if each.reliable}
    (spec.folder / f"{spec.name}.json").write_text(json.dumps(last))


async def _sites(spec: Members, orders: Orders, context: "zmq.Context[zmq.Socket[bytes]]") -> None:
    sites = [Site(context, spec, name) for name in spec.clients]
    said = False
    async with looked_after(sites, lambda: None):
        while not orders.stopped:
            await asyncio.sleep(POLL_S)
            orders.poll()
            if not said and sum(site.opened for site in sites) >= spec.opened and all(s.lane == UDP for s in sites):
                said = True
                ready()
    np.save(spec.folder / f"{spec.name}.npy", np.array([row for site in sites for row in site.rows], dtype=np.float64))
    last = {f"{stream.origin} {stream.topic}": seq for site in sites for stream, seq in site.last.items()}
    counts = {"lost": sum(site.lost for site in sites), "doubled": sum(site.doubled for site in sites)}
    (spec.folder / f"{spec.name}.json").write_text(json.dumps({**counts, "last": last}))


def main() -> None:
    spec = Members(**json.loads(sys.argv[1]))
    robots = not any(patterns for _, patterns in spec.clients.values())

    async def work() -> None:
        with zmq.Context() as context:
            await (_robots if robots else _sites)(spec, Orders(), context)

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(work())


def streams_of(clients: int) -> int:
    """How many streams so many robots have."""
    return clients * topics_of(ROBOT)


if __name__ == "__main__":
    main()
