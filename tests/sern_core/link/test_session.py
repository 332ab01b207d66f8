"""Sessions: hello and welcome and all that can go wrong with them, on a network that loses, repeats and reorders."""

import pytest

from sern_core.link.link import Link
from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.errors import VersionError, WireError
from sern_core.vocabulary.types import ClientName, PriorityClass
from sern_core.wire import framing
from sern_sim.models import LinkModel, Window
from sern_sim.ports import Port
from tests.world import ClockedPort, SimClient, World, spec


class OverPort:
    """A port with whose session it is over as soon as anything comes."""

    def __init__(self, port: Port, link: Link) -> None:
        self._link = link
        self.next_datagram = port.next_datagram
        self.next_deadline = port.next_deadline
        self.handle_timeout = port.handle_timeout
        self.connected = port.connected
        self.disconnected = port.disconnected

    def receive(self, _data: bytes, *, now: float) -> None:
        self._link.disconnected(now=now)


def kinds(world: World, client: SimClient) -> tuple[list[str], list[str]]:
    """Datagram kinds as they leave the client and the relay's side, as a pair of lists that grow."""
    lists: tuple[list[str], list[str]] = ([], [])
    for port, seen in zip((client.port, world.relay.port(client.name)), lists, strict=True):
        port.sent = lambda data, _now, seen=seen: seen.append(framing.Kind(data[2]).name)
    return lists


def inner(world: World, client: SimClient) -> HubPort:
    port = world.relay.port(client.name).inner
    assert isinstance(port, HubPort)
    return port


def test_hello_is_said_again_until_it_is_answered() -> None:
    world = World(lossless=False)
    model = LinkModel(delay_s=0.02, blackouts=(Window(0.0, 3.5),))
    client = world.client("robot", model)
    sent, answered = kinds(world, client)
    world.run(6.0)
    assert sent.count("HELLO") == 5 and answered.count("WELCOME") == 1
    assert client.ups == [False] and client.core.link.established


def test_a_lost_welcome_is_said_again_and_the_session_is_one() -> None:
    world = World(lossless=False)
    client = world.client("robot", LinkModel(delay_s=0.02), LinkModel(delay_s=0.02, blackouts=(Window(0.0, 0.5),)))
    sent, answered = kinds(world, client)
    world.run(3.0)
    assert sent.count("HELLO") == 2 and answered.count("WELCOME") == 2
    assert client.ups == [False] and client.core.link.established
    world.validate()


def test_an_old_hello_that_comes_late_does_not_end_the_session() -> None:
    world = World(lossless=False)
    client = world.client("robot", LinkModel(delay_s=0.02))
    hellos: list[bytes] = []
    client.port.sent = lambda data, _now: hellos.append(data) if data[2] == framing.Kind.HELLO else None
    world.run(1.0)
    world.hops["robot"].break_connection(reconnect_s=0.1)
    world.run(1.0)
    port = inner(world, client)
    tag = port.link.end.tag if port.link is not None else -1
    assert len(hellos) == 2 and tag == client.core.link.end.tag
    world.network.after(0.1, lambda now: port.receive(hellos[0], now=now))
    world.run(3.0)
    assert port.link is not None and port.link.end.tag == tag and port.link.established
    assert client.ups == [False, True]


def test_data_of_a_session_that_the_relay_has_lost_is_answered_with_reset() -> None:
    """A datagram path tells nobody that the process at its other end is a new one."""
    world = World(lossless=False)
    client = world.client("robot", LinkModel(delay_s=0.02))
    world.run(1.0)
    world.restart_relay()
    _, answered = kinds(world, client)
    world.run(3.0)
    assert answered[:2] == ["RESET", "WELCOME"]
    assert client.ups == [False, False] and client.core.link.established


def test_a_session_that_the_relay_closed_without_being_heard_is_found_dead() -> None:
    world = World(lossless=False)
    client = world.client("robot", LinkModel(delay_s=0.02), LinkModel(delay_s=0.02, blackouts=(Window(2.0, 2.3),)))
    world.run(2.1)
    link = world.relay.hub.links[client.name]
    world.network.after(0.0, lambda now: link.close("test", now=now))  # the datagram is lost
    world.run(5.0)
    assert client.ups == [False, True] and link.established and client.core.link.established


@pytest.mark.parametrize("closer", ["client", "relay"])
def test_close_is_told_and_a_client_comes_back(closer: str) -> None:
    world = World()
    client = world.client("robot")
    world.run(1.0)
    link = client.core.link if closer == "client" else world.relay.hub.links[client.name]
    world.network.after(0.0, lambda now: link.close("going down", now=now))
    world.run(0.5)
    assert not client.core.link.established
    links = world.relay.hub.links
    assert client.name not in links or not links[client.name].established
    world.run(3.0)
    # Who is told that the other side stops tries again; who stops does not.
    assert client.core.link.established is (closer == "relay")
    assert any("going down" in reason for reason in client.downs)


def test_a_newer_connection_retires_the_older() -> None:
    world = World()
    client = world.client("robot")
    site = world.client("site", patterns=["/robot/.*"])
    pose = client.publish("/robot/odom", spec(PriorityClass.CONTROL))
    world.run(1.0)
    hub = world.relay.hub
    older = inner(world, client)
    newer = HubPort(hub, client.name)
    link = client.core.link
    now = world.now
    link.disconnected(now=now)
    link.connected(now=now)
    hello = link.next_datagram(now=now)
    assert hello is not None
    newer.receive(hello, now=now)
    assert newer.current and not older.current and hub.clients.port_of[client.name] is newer
    assert older.next_datagram(now=now) is None and older.next_deadline() is None
    older.disconnected(now=now)
    assert newer.current and hub.links[client.name].established, "the end of the older one is not ours"
    assert site.core.link.established and pose.counters.offered == 0


def test_no_common_version_is_refused_by_name() -> None:
    world = World()
    client = world.client("robot")
    world.run(1.0)
    port = HubPort(world.relay.hub, client.name)
    hello = {"name": "robot", "boot": 1, "vmin": 90, "vmax": 99}
    port.receive(framing.encode_handshake(framing.Kind.HELLO, 3, 0, hello), now=world.now)
    answer = port.next_datagram(now=world.now)
    assert answer is not None and answer[2] == framing.Kind.REFUSE
    refusal = framing.decode_handshake(answer)
    assert refusal["code"] == "version" and "90 to 99" in refusal["why"] and "\n" not in refusal["why"]


def test_a_refused_client_is_told_and_tries_again() -> None:
    world = World()
    client = world.client("robot")
    world.run(1.0)
    port = world.relay.port(client.name)
    refuser = HubPort(world.relay.hub, world.client("other").name)
    world.hops["robot"].break_connection()
    world.network.replace_node(world.relay, world.relay, [(p, p) for p in world.relay.sides.values()])
    port.inner = refuser  # the key is another's
    world.run(5.0)
    assert client.rejections and client.rejections[0][0] == "name" and "not to robot" in client.rejections[0][1]
    port.inner = HubPort(world.relay.hub, client.name)
    world.run(10.0)
    assert client.core.link.established


def test_packet_numbers_do_not_wrap() -> None:
    world = World(lossless=False).watch()
    robot = world.client("robot", LinkModel(delay_s=0.02))
    site = world.client("site", LinkModel(delay_s=0.02), patterns=["/robot/.*"])
    log = robot.publish("/robot/log", spec(reliable=True))
    world.run(2.0)
    robot.every(0.05, log, b"x")
    world.run(1.0)
    for flight in (robot.core.link.lane.flight, world.relay.hub.links[site.name].lane.flight):
        flight.next_number = framing.MAX_PACKET_NUMBER - 5
    world.run(5.0)
    assert robot.ups == [False, True] and site.ups == [False, True]
    assert site.seqs("/robot/log") == list(range(1, len(robot.sent) + 1))[: len(site.got)] and len(site.got) > 100


def test_bytes_of_no_honest_peer_are_an_error_and_hurt_nobody_else() -> None:
    world = World()
    client, other = world.client("robot"), world.client("other")
    world.run(1.0)
    port = inner(world, client)
    assert port.link is not None
    for sessions, (kind, payload, error) in enumerate(
        (
            (None, b"", WireError),
            (None, b"junk" * 10, WireError),
            (framing.VERSION_MAX, b"\xff", WireError),
            (9, b"", VersionError),
            (None, framing.encode_handshake(framing.Kind.WELCOME, port.link.end.tag, 0, {}), WireError),
            (framing.VERSION_MAX, framing.encode_ack(0, 10**6, 0, 0, 0, 0), WireError),
            (framing.VERSION_MAX, framing.encode_ack(9, 1, 0, 0, 0, 0), WireError),
        ),
        start=1,
    ):
        assert client.name in world.up() and len(client.ups) == sessions
        header = (
            b"" if kind is None else framing.encode_header(framing.Kind.DATA, port.link.end.tag, 0, 0, version=kind)
        )
        with pytest.raises(error):
            port.receive(header + payload, now=world.now)
        assert client.name not in world.up(), "the session goes on over what could not be read"
        world.run(20.0)  # sessions that are taken from it one after another come ever later
    assert other.core.link.established and len(other.ups) == 1
    world.validate()


def test_a_stranger_announced_by_a_client_is_refused() -> None:
    world = World()
    client = world.client("robot")
    world.run(1.0)
    link = client.core.link
    link.end.name = world.client("other").name  # announce in another's name
    client.core.name = link.end.name
    channel = client.publish("/other/odom", spec())
    world.run(1.0)
    assert channel.wanted is False
    assert client.refusals and client.refusals[0][0] == "origin"


def test_ports_say_when_they_have_something_to_say() -> None:
    world = World()
    client = world.client("robot")
    port = world.relay.port(client.name)
    assert isinstance(port, ClockedPort) and not client.core.link.established
    world.run(1.0)
    assert not client.core.link.dirty and not port.dirty
    client.core.link.handle_timeout(now=client.now)
    assert client.core.link.dirty


def test_a_hello_that_is_said_again_after_another_relay_begins_no_second_session() -> None:
    """A relay that was started anew is another one to a client, whose HELLO names the one before. Its WELCOME may be
    late, so the HELLO comes twice. Two sessions with one number would each count from the beginning, and the client
    would take what is said in the second for what it had."""
    world = World(lossless=False)
    port = HubPort(world.relay.hub, ClientName("site"))
    words: framing.Envelope = {"name": "site", "boot": 7, "vmin": framing.VERSION_MIN, "vmax": framing.VERSION_MAX}
    now, answers = world.relay.now, []
    for number, tag in enumerate((3, 3, 4, 4), 1):
        hello = framing.encode_handshake(framing.Kind.HELLO, tag, number, words | {"last": 99})
        now += 5.0
        port.receive(hello, now=now)
        answers.append(framing.decode_handshake(port.next_datagram(now=now) or b"")["again"])
    assert answers == [False, True, False, True]


def test_a_session_whose_end_the_client_was_not_told_of_is_found_to_be_over() -> None:
    """A stream loses nothing, so the client asks nothing while something of its own is under way there."""
    world = World()
    client = world.client("robot", LinkModel(delay_s=0.02).as_stream())
    world.run(2.0)
    place, link = world.relay.port(client.name), world.relay.hub.links[client.name]
    real, place.inner = place.inner, OverPort(place.inner, link)
    world.run(0.7)
    place.inner = real
    world.run(5.0)
    assert [link.established, client.core.link.established] == [False, True], "it may be a blackout"
    world.run(20.0)
    assert [link.established, link.end.tag] == [True, client.core.link.end.tag]
