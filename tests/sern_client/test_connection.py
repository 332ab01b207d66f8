"""One relay's transports as one: what is opened, looked after and ended, in which order, whatever fails."""

from collections.abc import Callable
from typing import Any

import pytest
import zmq

from sern_client import connection as connections
from sern_client.connection import Connection
from sern_core.link.handshake import DISPLACED
from sern_core.site.client import ClientCore
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, Encoding
from sern_core.wire import framing
from sern_runtime import clock, ros_types
from sern_runtime.config.client import RelayConnection
from sern_runtime.config.keys import SecretKey
from sern_runtime.config.shared import LinkSection
from sern_runtime.zmq_setup import CurvePair
from tests.sern_client.sessions import Ignored
from tests.support import until
from tests.world import spec

NOBODY = "tcp://127.0.0.1:1"
"""Where no relay is."""
LOCAL = "tcp://localhost:1"

Context = zmq.Context[zmq.Socket[bytes]]


def new_core() -> ClientCore:
    events: Any = Ignored()
    return ClientCore(
        name=ClientName("robot"), boot=1, events=events, link=LinkParams(), scheduler=SchedulerParams(), now=clock.now()
    )


def connection_to(
    endpoint: str, core: ClientCore | None = None, *, down: Callable[[str], None] | None = None, **options: Any
) -> Connection:
    core = core or new_core()
    relay = RelayConnection(endpoint=endpoint, insecure=True, **options)
    return Connection(core, relay, LinkSection(), on_down=down or (lambda _reason: None))


class Part:
    """Stands for any transport: says in `said` what it is asked to do, and raises in `close` if it is told to."""

    def __init__(self, name: str, said: list[str], *, error: Exception | None = None) -> None:
        self.pump = self
        self.waiting = True
        self.bad_frames = 3
        self._name = name
        self._said = said
        self._error = error

    def __getattr__(self, call: str) -> Callable[..., None]:
        def called(*_: object, **_more: object) -> None:
            self._said.append(f"{self._name} {call}")
            if self._error is not None and call.startswith("close"):
                raise self._error

        return called


def with_parts(said: list[str], core: ClientCore | None = None, *, broken: tuple[str, ...] = ()) -> Any:
    """A connection all of whose parts are there; those in `broken` cannot be closed."""
    connection: Any = connection_to(NOBODY, core)
    for name in ("transport", "lane", "priority_lane", "name"):
        setattr(connection, name, Part(name, said, error=OSError(f"{name} is broken") if name in broken else None))
    return connection


@pytest.mark.parametrize(
    ("endpoint", "secure", "options", "opened"),
    [
        (NOBODY, True, {}, {"lane", "priority_lane"}),
        (NOBODY, True, {"udp": False}, {"priority_lane"}),
        (NOBODY, True, {"priority_connections": False}, {"lane"}),
        (NOBODY, False, {}, {"priority_lane"}),  # datagrams are sealed with keys that come over a proven stream
        (LOCAL, False, {}, {"priority_lane", "name"}),
        ("ipc://nobody", True, {}, set()),
    ],
)
async def test_what_is_opened_is_what_the_file_wants_and_the_address_allows(
    endpoint: str,
    secure: bool,
    options: dict[str, Any],
    opened: set[str],
    zmq_context: Context,
    robot_keys: SecretKey,
    relay_keys: SecretKey,
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    keys: CurvePair | None = robot_keys if secure else None
    connection = connection_to(endpoint, **options)
    connection.open(zmq_context, keys, (relay_keys.public_key,) if secure else ())
    assert connection.transport is not None
    assert {name for name in ("lane", "priority_lane", "name") if getattr(connection, name) is not None} == opened
    connection.close()


async def test_it_may_be_closed_at_any_time(zmq_context: Context) -> None:
    connection = connection_to(LOCAL)
    connection.close()
    assert not connection.waiting and connection.bad_frames == 0
    connection.wake()
    connection.session_began()
    connection.tick()
    await connection.leave()
    connection.open(zmq_context, None, ())
    for _ in range(2):
        connection.close()


async def test_a_relay_hears_from_it_and_what_is_no_frame_is_counted(zmq_context: Context) -> None:
    router = zmq_context.socket(zmq.ROUTER)
    try:
        port = router.bind_to_random_port("tcp://127.0.0.1")
        reasons: list[str] = []
        connection = connection_to(f"tcp://127.0.0.1:{port}", down=reasons.append, priority_connections=False)
        connection.open(zmq_context, None, ())
        await until(lambda: router.poll(0), "says HELLO")
        peer, data = router.recv_multipart()
        assert framing.decode_header(data).kind == framing.Kind.HELLO
        router.send_multipart([peer, b"no frame"])
        await until(lambda: connection.bad_frames == 1)
        connection.close()
    finally:
        router.close(linger=0)


async def test_waking_wakes_every_lane() -> None:
    said: list[str] = []
    connection = with_parts(said)
    connection.wake()
    assert said == ["transport kick", "lane kick", "priority_lane kick"]
    assert connection.waiting and connection.bad_frames == 9, "three on each lane"


async def test_a_session_asks_for_datagrams_before_it_gives_class_control_its_own() -> None:
    said: list[str] = []
    connection = with_parts(said)
    connection.session_began()
    connection.lane_offered({"t": "lane"})
    connection.lane_closed()
    connection.tick()
    assert said == [
        "lane ask", "priority_lane begin", "lane offered", "lane closed", "lane tick", "priority_lane tick", "name tick"
    ]  # fmt: skip


@pytest.mark.parametrize(
    "broken", [(), ("name",), ("lane",), ("priority_lane",), ("transport",), ("name", "priority_lane")]
)
async def test_all_of_it_ends_whatever_fails(broken: tuple[str, ...]) -> None:
    said: list[str] = []
    connection = with_parts(said, broken=broken)
    if broken:
        with pytest.raises(OSError, match="is broken"):
            connection.close()
    else:
        connection.close()
    assert said == ["name close", "lane closed", "priority_lane close", "transport close"]


# Draining -------------------------------------------------------------------------------------------------------------


async def test_a_client_that_owes_nothing_stops_at_once() -> None:
    said: list[str] = []
    connection = with_parts(said)
    await connection.drain(lambda: 0, limit_s=3600.0)
    assert said == []
    await connection.leave()
    assert said == ["transport kick", "lane kick", "priority_lane kick", "transport run", "transport run"]


async def test_what_is_still_being_made_is_waited_for() -> None:
    said: list[str] = []
    core = new_core()
    core.link.end.established = True
    left = iter((3, 2, 1, 0))
    await with_parts(said, core).drain(lambda: next(left), limit_s=3600.0)
    assert said.count("transport kick") == 3 and next(left, None) is None


@pytest.mark.parametrize(("limit_s", "patience_s"), [(0.0, 3600.0), (3600.0, 0.0)])
async def test_what_gets_nowhere_is_given_up_and_said(
    limit_s: float, patience_s: float, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reliable message was sent, and its confirmation never comes."""
    monkeypatch.setattr(connections, "PATIENCE_S", patience_s)
    monkeypatch.setattr(connections, "PATIENCE_RTTS", 0.0)
    core = new_core()
    now = clock.now()
    channel = core.publish(ros_types.topic_info("/robot/log", "std_msgs/msg/String", Encoding.CDR),
                           spec(reliable=True, depth=10), now=now)  # fmt: skip
    for _ in range(2):
        core.send(channel, b"kept", 1, now=now)
    assert len(channel.retained) == 2
    await with_parts([], core).drain(lambda: 0, limit_s=limit_s)
    assert "stopping with 2 reliable messages that not everyone has confirmed" in caplog.text


async def test_who_stops_does_not_take_the_session_back_from_another_of_its_name(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Told to end one of the two, a person ends this one: the other is left alone, whatever is owed here."""
    core = new_core()
    now = clock.now()
    core.link.connected(now=now)
    channel = core.publish(ros_types.topic_info("/robot/log", "std_msgs/msg/String", Encoding.CDR),
                           spec(reliable=True, depth=10), now=now)  # fmt: skip
    core.send(channel, b"kept", 1, now=now)
    end = core.link.end
    refusal = {"code": DISPLACED, "why": "another process connected as robot"}
    core.link.receive(framing.encode_handshake(framing.Kind.REFUSE, end.tag, 0, refusal), now=now)
    said: list[str] = []
    await with_parts(said, core).drain(lambda: 0, limit_s=1.0)
    assert said == [], "nobody is asked for a session"
    assert "stopping with 1 reliable messages that not everyone has confirmed" in caplog.text
