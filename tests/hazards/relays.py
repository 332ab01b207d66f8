"""Three relays on one fabric and their clients, each a process with keys, while something happens to one of them.

    relay1  robot1, which is driven
    relay2  robot2, operator, site
    relay3  nobody

Both robots play a numbered stream again and again, which the site records; the operator gives robot1 commands. Each
client has all relays in its list, relay3 as the second.
"""

import asyncio
import itertools
import json
import signal
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

from sern_client.endpoints.leftovers import finish
from sern_tools.harness.fabric import reached
from sern_tools.harness.files import write
from sern_tools.message_log import read_logs
from tests.daemons import Lab, Process, bodies, delivered, write_bag
from tests.hazards.field import COUNT, RATE
from tests.support import Patience
from tests.two_relays import TwoRelays

RELAYS: Final = ("relay1", "relay2", "relay3")
HOME: Final = {"robot1": "relay1", "robot2": "relay2", "operator": "relay2", "site": "relay2"}
SPARE: Final = "relay3"
DRIVE: Final = "/robot1/drive"
STREAMS: Final = ("/robot1/count", "/robot2/count")
LIFESPAN_S: Final = 0.3
COMMAND: Final = {"match": DRIVE, "class": "control", "lifespan_s": LIFESPAN_S}
MORE: Final = 50
"""A stream of which so many more messages have come is alive."""
FEW: Final = 5
LOOK_S: Final = 0.2
FAILOVER_S: Final = 2.0
"""Not less: a relay that was left is asked once a second, and counts as away after that time without an answer."""
RETURN_S: Final = 1.0
"""A client goes back to its relay when that has answered for so long."""


class Relays:
    """`processes` by name, whatever runs now."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.files = TwoRelays(lab, RELAYS)
        self.processes: dict[str, Process] = {}
        self.recordings: list[Path] = []
        """The site's, in their order."""
        self.again = 0
        """So many messages at the end of a recording may begin the next one, too."""
        self.anew: set[str] = set()
        """Streams whose robot was killed: they may begin anew."""
        self.stood: list[tuple[int, int]] = []
        """When somebody stood still, by the wall clock."""

    # --- processes --------------------------------------------------------------------------------------------------

    async def start_relays(self) -> None:
        for name in RELAYS:
            self.processes[name] = self.files.relay(name)
        for name in RELAYS:
            await self.processes[name].ready()
        await self.meet()

    async def start_clients(self) -> None:
        await self.start_site("site")
        for name in ("robot1", "robot2"):
            await self.start(name, self.robot_file(name))
        await self.start("operator", self.operator_file())

    async def start(self, name: str, file: Path) -> Process:
        order = [HOME[name], SPARE, *(relay for relay in RELAYS if relay not in (HOME[name], SPARE))]
        file = self.files.going(file, *order, failover_s=FAILOVER_S, return_s=RETURN_S)
        self.processes[name] = await self.lab.process(file).ready()
        return self.processes[name]

    async def start_site(self, recording: str) -> None:
        self.recordings.append(self.lab.directory / f"{recording}.bag")
        await self.start("site", self.lab.recorder_file("site", *STREAMS, path=recording))

    def robot_file(self, name: str) -> Path:
        """Plays, and records what it is told."""
        bag = self.lab.directory / f"{name}.bag"
        if not bag.exists():  # else it is that of an earlier process
            write_bag(bag, {"/count": COUNT})
        play = {"rate": RATE, "loop": True}
        if name != "robot1":
            return self.lab.player_file(name, bag, play=play)
        file = self.lab.player_file(name, bag, play=play, subscribe=[DRIVE], message_log=f"{name}.csv")
        content: dict[str, Any] = json.loads(file.read_text())
        content["endpoint"] = [content["endpoint"], {"kind": "record", "path": "told", "overwrite": True}]
        return write(self.lab.directory, name, content)

    def operator_file(self) -> Path:
        bag = write_bag(self.lab.directory / "operator.bag", {DRIVE: COUNT})
        play = {"rate": RATE / 4, "loop": True, "wait_for": []}
        more: dict[str, Any] = {"client": {"namespace": "/"}, "topics": [COMMAND], "message_log": "operator.csv"}
        return self.lab.player_file("operator", bag, play=play, **more)

    async def again_at(self, name: str) -> None:
        """A relay that was killed is there again."""
        self.processes[name] = await self.files.relay(name).ready()

    # --- what happens -----------------------------------------------------------------------------------------------

    def kill(self, name: str) -> None:
        self.processes.pop(name).kill()

    def stop(self, name: str) -> None:
        """Have it stand still."""
        self.stood.append((time.time_ns(), 0))
        self.processes[name].signal(signal.SIGSTOP)

    def go_on(self, name: str) -> None:
        self.stood[-1] = self.stood[-1][0], time.time_ns()
        self.processes[name].signal(signal.SIGCONT)

    # --- what comes of it -------------------------------------------------------------------------------------------

    async def until(self, name: str, condition: Callable[[], object], what: str) -> None:
        """Ask a few times a second: whoever is asked has other work to do."""
        process, patience = self.processes[name], Patience()
        while not condition():
            assert process.process.poll() is None, f"{name} has ended:\n{process.text}"
            assert not patience.over(), f"{name} not in time: {what}"
            await asyncio.sleep(LOOK_S)

    async def meet(self) -> None:
        """Until every two relays have a session with each other."""
        for name in RELAYS:
            process, others = self.processes[name], {*RELAYS} - {name}
            await self.until(name, lambda p=process, o=others: reached(p.text) == o, "is connected to the others")  # type: ignore[misc]

    async def parted(self, name: str, other: str) -> None:
        """Until a relay has noticed that another one is gone."""
        process = self.processes[name]
        await self.until(name, lambda: other not in reached(process.text), f"is not connected to {other}")

    def homes(self, client: str, relays: Iterable[str] = RELAYS) -> list[str]:
        """The relays at which a client has a session that is alive, of those that can be asked."""
        return [relay for relay in relays if self.state(relay, client) == "connected"]

    def state(self, relay: str, client: str) -> str:
        rows: list[dict[str, Any]] = self.processes[relay].json("/api/clients")["clients"]
        return next((str(row["state"]) for row in rows if row["name"] == client), "never")

    def peer(self, client: str, name: str) -> str:
        """What a client says of another one whose topics it takes."""
        rows: list[dict[str, Any]] = self.processes[client].json("/api/peers")
        return next((str(row["status"]) for row in rows if row["peer"] == name), "never")

    async def at(self, relay: str, *clients: str) -> None:
        """Until these clients have a session there."""
        for client in clients:
            await self.until(relay, lambda c=client: self.state(relay, c) == "connected", f"has {client}")  # type: ignore[misc]

    async def at_home(self) -> None:
        """Until each client has a session at its relay, and nowhere else."""
        for client, relay in HOME.items():
            await self.until(client, lambda c=client, r=relay: self.homes(c) == [r], f"is at {relay} alone")  # type: ignore[misc]

    async def goes_on(self, *streams: str) -> None:
        """Streams, all of them by default, and commands are alive now, if those who take them run."""
        for who, topics, count in (("site", streams or STREAMS, MORE), ("robot1", (DRIVE,), FEW)):
            process = self.processes[who]
            for topic in topics:
                least = delivered(process, topic) + count
                await self.until(who, lambda t=topic, n=least, p=process: delivered(p, t) >= n, f"goes on with {topic}")  # type: ignore[misc]

    async def finish(self) -> None:
        """All is as it was; stop all of them; what came is whole."""
        await self.meet()
        await self.at_home()
        await self.goes_on()
        for name in ("operator", "robot1", "robot2", "site", *RELAYS):
            await self.processes[name].stop()
        for stream in STREAMS:
            self._whole(stream)
        self._timely()

    def _whole(self, stream: str) -> None:
        """A stream is in the recordings once, in order and without a gap."""
        robot, topic = stream[1:].split("/")
        played = {body: at for at, body in enumerate(bodies(self.lab.directory / f"{robot}.bag")[f"/{topic}"])}
        arrived: list[int] = []
        for path in self.recordings:
            left = path.with_name(f"{path.name}.active")  # of a process that was killed
            if left.exists():
                finish(left)
            found = [played[body] for body in bodies(path).get(stream, [])]
            twice = max(n for n in range(self.again + 1) if n == 0 or found[:n] == arrived[-n:])
            arrived += found[twice:]
        assert arrived[0] == 0 and len(arrived) > MORE
        breaks = [
            (one, other) for one, other in itertools.pairwise(arrived) if other != (one + 1) % COUNT
        ]  # fmt: skip
        assert len(breaks) <= (stream in self.anew) and all(other == 0 for _, other in breaks), (stream, breaks)

    def _timely(self) -> None:
        """No command was obeyed past its lifespan: none from before somebody stood still after that, either."""
        logs = read_logs((name, self.lab.directory / f"{name}.csv") for name in ("operator", "robot1"))
        log = logs[DRIVE]
        assert log.deliveries and all(each.age_s is not None and each.age_s <= LIFESPAN_S for each in log.deliveries)
        for stopped_ns, went_on_ns in self.stood:
            assert went_on_ns - stopped_ns > 1e9 * LIFESPAN_S
            old = {seq for seq, offer in log.offers.items() if offer.wall_ns < stopped_ns}
            late = [each for each in log.deliveries if each.seq in old and each.wall_ns > went_on_ns]
            assert not late, f"{len(late)} commands from before, e.g. {late[0]}"


@asynccontextmanager
async def relays(directory: Path) -> AsyncIterator[Relays]:
    """A world whose streams and commands run; they must run at the end, and be whole."""
    async with Lab(directory, *HOME) as lab:
        world = Relays(lab)
        await world.start_relays()
        await world.start_clients()
        await world.goes_on()
        yield world
        await world.finish()
