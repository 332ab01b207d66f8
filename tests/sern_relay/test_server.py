"""The relay's connections as its server keeps them: who is let speak, who is cut, and who else notices."""

from collections.abc import Callable
from typing import Any

import pytest

from sern_core.relay.hub import Hub
from sern_core.site.client import ClientCore
from sern_core.vocabulary.params import LinkParams, Redundancy, SchedulerParams
from sern_core.vocabulary.types import ClientName
from sern_relay import server as servers
from sern_relay.server import MAX_PORTS, REFUSED_KEY, RelayServer
from sern_runtime import clock
from sern_runtime.config.keys import KeyStatus, SecretKey, user_id
from sern_runtime.monitor import Connection
from sern_runtime.priority_paths import CONNECTIONS
from sern_runtime.zmq_socket import PeerDetails, SendResult
from tests.sern_client.sessions import Ignored
from tests.world import OPEN_ACCESS

KEY = "k" * 40
ROBOT = user_id(ClientName("robot"), KEY)
SITE = user_id(ClientName("site"), KEY)


class FakeTable:
    """`ConnectionTable` of connections that a test opens: their numbers are those of their routing ids."""

    def __init__(self, *_: object, on_change: Callable[[], None], **_more: object) -> None:
        self.cuts: list[int] = []
        self.silent = 0
        self.closed = False
        self._open: dict[int, Connection] = {}
        self._on_change = on_change

    def open(self, fd: int) -> None:
        self._open[fd] = Connection(None, "", 0.0)

    def lose(self, fd: int) -> None:
        del self._open[fd]
        self._on_change()

    def by_fd(self, fd: int) -> Connection | None:
        return self._open.get(fd)

    def ended(self, fd: int) -> bool:
        return fd not in self._open or fd in self.cuts

    def bind_user(self, fd: int, user: str) -> None:
        self._open[fd].user = user

    def cut(self, fd: int) -> None:
        self.cuts.append(fd)

    def cut_user(self, user: str) -> int:
        found = [fd for fd, connection in self._open.items() if connection.user == user]
        self.cuts += found
        return len(found)

    def cut_silent(self, _after_s: float) -> int:
        return self.silent

    def handles(self) -> list[Any]:
        return []

    def close(self) -> None:
        self.closed = True


class FakeSocket:
    """`RouterSocket` into which a test puts what clients send."""

    def __init__(self, _raw: object, received: Callable[[bytes, str, bytes], None], **_more: object) -> None:
        self.sent: list[tuple[bytes, bytes]] = []
        self.closed = False
        self.last: list[Callable[[], None]] = []
        """What clients said last, and the relay has not read yet."""
        self._received = received
        self._fd = 0

    def when_empty(self, tell: Callable[[], None]) -> None:
        for said in self.last:
            said()
        tell()

    def peer_details(self) -> PeerDetails:
        return PeerDetails("192.0.2.1", self._fd)

    def deliver(self, fd: int, user: str, data: bytes) -> None:
        self._fd = fd
        self._received(b"%d" % fd, user, data)

    def send_to(self, routing_id: bytes, body: bytes) -> SendResult:
        self.sent.append((routing_id, body))
        return SendResult.OK

    def close(self) -> None:
        self.closed = True


class FakeInflow:
    def __init__(self, *_: object) -> None: ...

    def close(self) -> None: ...


class Relay:
    """A server over fakes, with a hub; `status` is what is said of every key."""

    def __init__(self, patch: pytest.MonkeyPatch, keys: SecretKey | None) -> None:
        patch.setattr(servers, "make_server", lambda *_, **_more: None)
        patch.setattr(servers, "ConnectionTable", FakeTable)
        patch.setattr(servers, "RouterSocket", FakeSocket)
        patch.setattr(servers, "Inflow", FakeInflow)
        events: Any = Ignored()
        self.hub = Hub(
            name=ClientName("relay"), boot=1, access=OPEN_ACCESS, known=lambda _name: True, events=events,
            link=LinkParams(), scheduler=SchedulerParams(), wall_ns=lambda now: int(now * 1e9), now=clock.now(),
        )  # fmt: skip
        self.status = KeyStatus.VALID
        self.afters = 0
        ctx: Any = None
        self.server = RelayServer(
            ctx, self.hub, ("tcp://192.0.2.9:1",), keys, "sern", key_status=lambda _name, _key: self.status,
            heartbeat_timeout_s=1.0, handshake_interval_s=1.0, max_connections=10,
            redundancy=Redundancy.AUTO, after=self._after,
        )  # fmt: skip
        table: Any = self.server.connections
        socket: Any = self.server.socket
        self.table: FakeTable = table
        self.socket: FakeSocket = socket
        self._fd = 0

    def _after(self) -> None:
        self.afters += 1

    def connect(self) -> int:
        self._fd += 1
        self.table.open(self._fd)
        return self._fd

    def says(self, user: str, data: bytes) -> int:
        """Somebody says this first on a connection of its own."""
        fd = self.connect()
        self.socket.deliver(fd, user, data)
        return fd

    @property
    def users(self) -> list[str]:
        """Whose the connections of sessions are."""
        return [connection.client for connection, _served in self.server.clients.sessions()]

    def session(self, name: str = "robot") -> tuple[int, ClientCore]:
        """A client with a session, and the number of its connection."""
        user, core = user_id(ClientName(name), KEY), client(name)
        fd = self.says(user, hello(core))
        for _ in range(20):
            self.server.run_all()
            for routing_id, data in self.socket.sent:
                if routing_id == b"%d" % fd:
                    core.link.receive(data, now=clock.now())
            self.socket.sent.clear()
            while (said := core.link.next_datagram(now=clock.now())) is not None:
                self.socket.deliver(fd, user, said)
        assert core.link.established and self.hub.links[core.name].established
        return fd, core


def client(name: str = "robot", boot: int = 2) -> ClientCore:
    events: Any = Ignored()
    return ClientCore(
        name=ClientName(name), boot=boot, events=events, link=LinkParams(), scheduler=SchedulerParams(), now=clock.now()
    )


def hello(core: ClientCore) -> bytes:
    core.link.connected(now=clock.now())
    data = core.link.next_datagram(now=clock.now())
    assert data is not None
    return data


@pytest.fixture
def relay(monkeypatch: pytest.MonkeyPatch, relay_keys: SecretKey) -> Relay:
    return Relay(monkeypatch, relay_keys)


async def test_a_client_that_says_hello_is_answered_on_its_connection(relay: Relay) -> None:
    fd = relay.says(ROBOT, hello(client()))
    relay.server.run_all()
    assert relay.users == ["robot"] and relay.afters == 1 and relay.table.cuts == []
    assert {routing_id for routing_id, _data in relay.socket.sent} == {b"%d" % fd}
    relay.server.close()


async def test_a_connection_whose_identity_changes_is_cut(relay: Relay, caplog: pytest.LogCaptureFixture) -> None:
    fd, core = relay.session()
    relay.socket.deliver(fd, SITE, b"anything")
    assert relay.table.cuts == [fd] and relay.users == [] and not list(relay.server.clients.lost())
    assert "connection of robot closed: its identity changed to" in caplog.text
    assert relay.server.bad_frames == 0, "nobody has read it"
    assert not relay.hub.links[core.name].handshake.transport_up
    relay.server.close()


@pytest.mark.parametrize("status", REFUSED_KEY)
async def test_a_key_that_no_longer_holds_says_nothing(
    status: KeyStatus, relay: Relay, caplog: pytest.LogCaptureFixture
) -> None:
    relay.status = status
    fd = relay.says(ROBOT, hello(client()))
    assert relay.table.cuts == [fd] and relay.server.revoked == 1 and relay.users == [] and not relay.hub.links
    assert f"connection from 192.0.2.1 closed: the key of robot {REFUSED_KEY[status]}" in caplog.text
    relay.server.close()


async def test_who_has_no_name_is_cut(relay: Relay) -> None:
    for user in ("", "robot", f"../robot {KEY}"):
        relay.says(user, hello(client()))
    assert relay.table.cuts == [1, 2, 3] and relay.server.bad_frames == 3 and relay.users == []
    relay.server.close()


async def test_what_was_cut_already_is_not_heard(relay: Relay) -> None:
    fd = relay.connect()
    relay.table.cut(fd)
    relay.socket.deliver(fd, ROBOT, hello(client()))
    assert relay.users == [] and relay.afters == 0
    relay.server.close()


async def test_a_bad_frame_costs_its_own_connection(relay: Relay, caplog: pytest.LogCaptureFixture) -> None:
    fd, _robot = relay.session()
    other, site = relay.session("site")
    relay.socket.deliver(fd, ROBOT, b"no frame")
    assert relay.table.cuts == [fd] and relay.server.bad_frames == 1 and relay.users == ["site"]
    assert "connection of robot closed: bad frame" in caplog.text
    assert relay.hub.links[site.name].handshake.transport_up and other not in relay.table.cuts
    relay.server.close()


async def test_beyond_the_limit_the_oldest_without_its_session_goes(
    relay: Relay, caplog: pytest.LogCaptureFixture
) -> None:
    first, robot = relay.session()
    stray = robot.link.next_datagram(now=clock.now()) or b"S\x01\x04" + bytes(17)
    spare = [relay.says(ROBOT, stray) for _ in range(MAX_PORTS - 1)]
    assert relay.table.cuts == []
    for count in (1, 2):
        relay.says(ROBOT, stray)
        assert relay.table.cuts == spare[:count] and relay.server.surplus == count
    assert len(relay.users) == MAX_PORTS and first not in relay.table.cuts
    assert caplog.text.count("robot has more than") == 1
    relay.server.close()


async def test_a_connection_that_is_lost_ends_here(relay: Relay) -> None:
    fd, core = relay.session()
    relay.session("site")
    relay.table.lose(fd)
    assert relay.users == ["site"] and not relay.hub.links[core.name].handshake.transport_up
    relay.table.open(fd)  # its number is another's now
    relay.socket.deliver(fd, ROBOT, hello(client(boot=3)))
    assert relay.users == ["site", "robot"]
    relay.server.close()


async def test_what_a_connection_said_last_is_read_before_it_ends(relay: Relay) -> None:
    """The end of a connection may be heard of before its last messages are taken."""
    fd, core = relay.session()
    core.link.close("it goes to another relay", now=clock.now(), moved=True)
    goodbye = core.link.next_datagram(now=clock.now())
    assert goodbye is not None
    relay.socket.last.append(lambda: relay.socket.deliver(fd, ROBOT, goodbye))
    relay.table.lose(fd)
    assert relay.users == [] and not relay.hub.links  # it is forgotten, not waited for
    relay.server.close()


async def test_connections_for_class_control_belong_to_a_session_of_their_own_client(
    relay: Relay, caplog: pytest.LogCaptureFixture
) -> None:
    _fd, robot = relay.session()
    join = robot.link.handshake.join(clock.now())
    assert join is not None
    stranger = relay.says(SITE, join)
    assert relay.table.cuts == [stranger] and relay.server.priority_lanes.joined == []
    joined = [relay.says(ROBOT, join) for _ in range(CONNECTIONS + 1)]
    assert relay.table.cuts == [stranger, joined[0]], "the oldest gives way"
    assert [each.fd for each in relay.server.priority_lanes.joined] == joined[1:]
    assert relay.users == ["robot"] and relay.server.surplus == 0
    relay.socket.deliver(joined[1], ROBOT, join)  # said again
    relay.socket.deliver(joined[1], SITE, b"anything")
    assert relay.table.cuts[-1] == joined[1]
    assert "connection of robot for class control closed: its identity changed" in caplog.text
    relay.socket.deliver(joined[2], ROBOT, b"no frame")
    assert relay.server.priority_lanes.joined == [] and relay.users == ["robot"]
    relay.server.close()


async def test_a_join_of_no_session_is_counted(relay: Relay) -> None:
    _fd, robot = relay.session()
    join = robot.link.handshake.join(clock.now())
    assert join is not None
    relay.hub.links[robot.name].close("bye", now=clock.now())
    fd = relay.says(ROBOT, join)
    lanes = relay.server.priority_lanes
    assert relay.table.cuts == [fd] and lanes.refused == 1 and lanes.joined == []
    relay.server.close()


async def test_all_connections_of_a_client_are_cut_together(relay: Relay) -> None:
    fd, robot = relay.session()
    relay.session("site")
    join = robot.link.handshake.join(clock.now())
    assert join is not None
    control = relay.says(ROBOT, join)
    assert relay.server.cut_client("robot") == 2
    assert relay.table.cuts == [fd, control] and relay.users == ["site"] and relay.server.priority_lanes.joined == []
    relay.server.close()


async def test_connections_that_say_nothing_are_cut_and_counted(relay: Relay) -> None:
    relay.connect()
    assert relay.server.cut_unbound() == 1
    relay.table.silent = 2
    relay.server.look()
    assert relay.server.silent == 2
    relay.server.close()


async def test_without_keys_a_client_says_first_who_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    relay = Relay(monkeypatch, None)
    relay.says("", b"S\x01\x04" + bytes(17))
    assert relay.table.cuts == [1] and relay.server.bad_frames == 1
    relay.says("", hello(client()))
    assert relay.users == ["robot"]
    relay.server.close()


async def test_nothing_is_served_after_the_end(relay: Relay) -> None:
    _fd, robot = relay.session()
    join = robot.link.handshake.join(clock.now())
    assert join is not None
    relay.says(ROBOT, join)
    relay.server.close()
    assert relay.users == [] and relay.server.priority_lanes.joined == [] and relay.socket.closed and relay.table.closed
    relay.socket.sent.clear()
    relay.server.flush()
    relay.server.run_all()
    assert relay.socket.sent == []
