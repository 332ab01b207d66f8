"""What a site says of its peers: bytes of ROS 1 and CDR that rosbags reads, lines, rows, topics that end and return."""

import logging
from collections import Counter
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from sern_client.endpoints.base import Publisher
from sern_client.link_state import LinkState
from sern_client.link_topics import ARRAY_TYPE, STATUS_TYPE, LinkTopics, LinkView
from sern_client.withdrawal import MAX_KEPT, Kept, Withdrawal
from sern_core.site.client import ClientCore
from sern_core.site.peers import PeerStatus
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime import clock, ros_types
from sern_runtime.optional import OptionalParts
from tests.bridges import Shell, bridge_of
from tests.sern_client.sessions import Ignored
from tests.support import until
from tests.world import spec

CONNECTED, GONE, UNKNOWN = PeerStatus.CONNECTED, PeerStatus.GONE, PeerStatus.UNKNOWN
STAMP_NS = 1_700_000_000_123_456_789
VIEWS = [
    LinkView("relay", True, CONNECTED, 60.0, 0.25, 0.05, "relay", "udp", ""),
    LinkView("jackal1", False, CONNECTED, 12.3456, 0.1, 0.15, "jackal1", "udp", ""),
    LinkView("jackal2", False, GONE, 7.0, 8.5, 0.05, "relay", "zmq", "the relay does not reach it"),
    LinkView("jackal3", False, UNKNOWN, 3.0, None, None, "relay", "", "our own link is down"),
]


class Opened:
    """One publisher."""

    def __init__(self, owner: "Endpoint", info: TopicInfo) -> None:
        self.owner = owner
        self.info = info
        self.bodies: list[bytes] = []
        self.closed = False

    def publish(self, body: bytes, stamp_ns: int) -> None:
        assert not self.closed
        self.bodies.append(body)

    def close(self) -> None:
        assert not self.closed
        self.closed = True


class Endpoint:
    """Keeps what is advertised; refuses names in `refused`."""

    encoding = None

    def __init__(self) -> None:
        self.opened: list[Opened] = []
        self.refused: set[str] = set()

    def advertise(self, info: TopicInfo) -> Publisher:
        if info.name in self.refused:
            raise ConfigError(f"{info.name}: not here")
        self.opened.append(Opened(self, info))
        return self.opened[-1]

    @property
    def open(self) -> dict[str, Opened]:
        return {opened.info.name: opened for opened in self.opened if not opened.closed}


def decoded(opened: Opened) -> Any:
    """The last message, read by rosbags' own stores."""
    if opened.info.encoding is Encoding.ROS1:
        store = get_typestore(Stores.ROS1_NOETIC)
        return store.deserialize_ros1(opened.bodies[-1], opened.info.type_name)
    return get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(opened.bodies[-1], opened.info.type_name)


# --- what is published ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_each_link_is_a_latched_status_and_all_of_them_are_an_array(encoding: Encoding) -> None:
    endpoint = Endpoint()
    topics = LinkTopics("site", encoding, endpoint.advertise, diagnostics=True)
    topics.publish(VIEWS, STAMP_NS)
    names = ["/sern/link", "/jackal1/sern/link", "/jackal2/sern/link", "/jackal3/sern/link", "/diagnostics"]
    assert list(endpoint.open) == names
    for name in names[:4]:
        info = endpoint.open[name].info
        assert (info.type_name, info.latched, info.encoding) == (STATUS_TYPE, True, encoding)
        assert info.type_hash == ros_types.hash_of(STATUS_TYPE, info.definition, encoding)
    assert (endpoint.open["/diagnostics"].info.type_name, endpoint.open["/diagnostics"].info.latched) == (
        ARRAY_TYPE,
        False,
    )
    gone = decoded(endpoint.open["/jackal2/sern/link"])
    assert (gone.level, gone.name, gone.hardware_id) == (2, "sern site: jackal2", "jackal2")
    assert gone.message == "jackal2 is gone for 7 s (the relay does not reach it)"
    assert {pair.key: pair.value for pair in gone.values} == {
        "connected": "false",
        "status": "gone",
        "since_s": "7.000",
        "age_s": "8.500",
        "round_trip_s": "0.050",
        "round_trip_to": "relay",
        "lane": "zmq",
    }
    there = decoded(endpoint.open["/jackal1/sern/link"])
    assert (there.level, there.message) == (0, "jackal1 is connected")
    assert {pair.key: pair.value for pair in there.values}["since_s"] == "12.346"
    unknown = decoded(endpoint.open["/jackal3/sern/link"])
    assert unknown.level == 3
    assert {pair.key: pair.value for pair in unknown.values}["age_s"] == ""
    array = decoded(endpoint.open["/diagnostics"])
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert [(status.level, status.hardware_id) for status in array.status] == [
        (0, "relay"),
        (0, "jackal1"),
        (2, "jackal2"),
        (3, "jackal3"),
    ]
    topics.publish(VIEWS[:2], STAMP_NS)
    assert list(endpoint.open) == ["/sern/link", "/jackal1/sern/link", "/diagnostics"]
    if encoding is Encoding.ROS1:
        assert decoded(endpoint.open["/diagnostics"]).header.seq == 2
    topics.close()
    assert endpoint.open == {} and topics.held == Counter()


def test_without_diagnostics_only_the_links_have_topics() -> None:
    endpoint = Endpoint()
    topics = LinkTopics("site", Encoding.ROS1, endpoint.advertise, diagnostics=False)
    topics.publish(VIEWS[:2], STAMP_NS)
    assert list(endpoint.open) == ["/sern/link", "/jackal1/sern/link"]


def test_a_topic_that_the_endpoint_refuses_is_said_once_and_costs_the_others_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    endpoint = Endpoint()
    endpoint.refused = {"/diagnostics"}
    topics = LinkTopics("site", Encoding.ROS1, endpoint.advertise, diagnostics=True)
    for _ in range(3):
        topics.publish(VIEWS, STAMP_NS)
    assert [record.message for record in caplog.records] == [
        "the state of the link is not published there (link_state in the file): /diagnostics: not here"
    ]
    assert len(endpoint.open["/jackal1/sern/link"].bodies) == 3
    endpoint.refused.clear()
    topics.publish(VIEWS, STAMP_NS)
    assert len(endpoint.open["/diagnostics"].bodies) == 1


def test_who_is_given_up_is_published_once_and_again_when_that_changes() -> None:
    endpoint = Endpoint()
    topics = LinkTopics("site", Encoding.CDR, endpoint.advertise, diagnostics=True)
    gone = VIEWS[2]
    over = gone._replace(since_s=600.0, why="given up by the relay", given_up=True)
    topic = "/jackal2/sern/link"

    def publish(view: LinkView) -> tuple[int, str, str]:
        """Messages on its topic, what the last one says, and what /diagnostics says."""
        topics.publish([VIEWS[0], view], STAMP_NS)
        opened = endpoint.open[topic]
        return len(opened.bodies), decoded(opened).message, decoded(endpoint.open["/diagnostics"]).status[1].message

    for number in (1, 2):
        assert publish(gone)[0] == number
    given_up = "jackal2 is gone for 600 s (given up by the relay)"
    for later_s in range(3):
        assert publish(over._replace(since_s=600.0 + later_s)) == (3, given_up, given_up)
    unknown = over._replace(status=UNKNOWN, since_s=1.0, why="our own link is down")
    for _ in range(2):
        assert publish(unknown)[:2] == (4, "jackal2 is unknown for 1 s (our own link is down)")
    assert publish(over)[:2] == (5, given_up)
    topics.repair([TopicName(topic)])
    for _ in range(2):
        assert publish(over)[:2] == (1, given_up)
    for number in (2, 3):
        assert publish(gone)[0] == number
    assert publish(over)[0] == 4
    topics.publish(VIEWS[:1], STAMP_NS)
    assert publish(over)[0] == 1  # a new topic of that name
    assert len(endpoint.open["/sern/link"].bodies) == 15
    endpoint.refused = {"/jackal3/sern/link"}
    for _ in range(2):
        topics.publish([over._replace(peer="jackal3")], STAMP_NS)
    assert "/jackal3/sern/link" not in endpoint.open
    endpoint.refused.clear()
    topics.publish([over._replace(peer="jackal3")], STAMP_NS)
    assert len(endpoint.open["/jackal3/sern/link"].bodies) == 1


def test_what_is_not_open_as_it_should_be_is_opened_anew() -> None:
    endpoint = Endpoint()
    topics = LinkTopics("site", Encoding.ROS1, endpoint.advertise, diagnostics=False)
    topics.publish(VIEWS[:1], STAMP_NS)
    topics.repair([TopicName("/sern/link"), TopicName("/other")])
    assert endpoint.open == {}
    topics.publish(VIEWS[:1], STAMP_NS)
    assert topics.held == {"/sern/link": 1}


# --- what is said -----------------------------------------------------------------------------------------------------


@pytest.fixture
def still(monkeypatch: pytest.MonkeyPatch) -> None:
    """What ages are counted by stands still, at whole seconds: nobody is away for longer because a test takes long."""
    now = float(int(clock.now()))
    monkeypatch.setattr(clock, "now", lambda: now)


class Withdrawn:
    def __init__(self) -> None:
        self.names: set[str] = set()

    def withdraw(self, origin: ClientName) -> None:
        self.names.add(origin)

    def restore(self, origin: ClientName) -> None:
        self.names.discard(origin)


class Site:
    """A core whose link is up without a relay, and its link state; tests say what the relay would."""

    def __init__(self, *, withdraw_after_s: float | None = None, period_s: float = 60.0) -> None:
        self.core = ClientCore(
            name=ClientName("site"), boot=1, events=Ignored(), link=LinkParams(), scheduler=SchedulerParams(),
            now=clock.now(),
        )  # fmt: skip
        self.endpoint = Endpoint()
        self.withdrawn = Withdrawn()
        self.parts = OptionalParts("link_state")
        self.state = LinkState(
            self.core,
            LinkTopics("site", Encoding.ROS1, self.endpoint.advertise, diagnostics=False),
            self.withdrawn,
            period_s=period_s,
            withdraw_after_s=withdraw_after_s,
            reason=lambda: "connection lost",
            parts=self.parts,
        )
        self.core.link.end.established = True
        self.core.peers.session_began(now=clock.now())

    def lose_link(self) -> None:
        self.core.link.end.established = False
        self.core.peers.session_ended(now=clock.now())

    def told(self, name: str, *, up: bool, for_s: float = 0.0, rtt_s: float | None = None) -> None:
        item = {"name": name, "up": up, "for": for_s, "rtt": rtt_s}
        self.core.peers.told({"t": "peers", "peers": [item]}, now=clock.now())


async def test_a_change_is_published_at_once_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    site = Site()
    site.state.start()
    site.told("jackal1", up=True)
    await until(lambda: "/jackal1/sern/link" in site.endpoint.open, "the topic is there")
    opened = site.endpoint.open["/jackal1/sern/link"]
    assert decoded(opened).level == 0
    site.told("jackal1", up=False, for_s=2.0)
    await until(lambda: decoded(opened).level == 2, "it says so long before the next period")
    site.told("jackal1", up=False, for_s=3.0)
    site.told("jackal1", up=True)
    await until(lambda: decoded(opened).level == 0, "it is back")
    site.lose_link()
    await until(lambda: decoded(opened).level == 3, "nobody knows")
    site.core.link.end.established = True
    site.core.peers.session_began(now=clock.now())
    site.told("jackal1", up=True)
    await until(lambda: decoded(opened).level == 0, "it was there all the while, which is no news")
    site.core.link.lane.stalled = True
    site.state.look()
    await until(lambda: decoded(opened).level == 3, "a silent link is as good as none")
    assert decoded(site.endpoint.open["/sern/link"]).message.endswith("(no acknowledgement comes)")
    site.core.link.lane.stalled = False
    site.state.look()
    await until(lambda: decoded(opened).level == 0, "what was said before holds again")
    site.lose_link()
    await until(lambda: decoded(opened).level == 3, "nobody knows")
    lines = [record.message for record in caplog.records if "jackal1" in record.message]
    assert [line.split(" after ")[0] for line in lines] == [
        "jackal1 is there",
        "jackal1 is gone: the relay does not reach it any more",
        "jackal1 is back",
    ]
    assert decoded(site.endpoint.open["/sern/link"]).message.endswith("(connection lost)")
    site.state.close()
    assert site.endpoint.open == {} and site.parts.failures == {"link_state": 0}


async def test_it_is_published_again_each_period() -> None:
    site = Site(period_s=0.1)
    site.state.start()
    await until(lambda: site.endpoint.opened and len(site.endpoint.opened[0].bodies) >= 5, "several times")
    site.state.close()


@pytest.mark.usefixtures("still")
async def test_rows_and_detail_name_who_is_away() -> None:
    site = Site()
    assert site.state.detail() == ""
    for name in ("jackal1", "jackal2", "jackal3"):
        site.told(name, up=name != "jackal2", for_s=30.0, rtt_s=0.04)
    assert site.state.detail() == "1 of 3 peers away: jackal2 is gone for 30 s (the relay does not reach it)"
    rows = {row["peer"]: row for row in site.state.to_json()}
    assert rows["jackal1"]["connected"] is True and rows["jackal1"]["age_s"] is None
    assert rows["jackal2"]["status"] == "gone"
    assert rows["jackal2"]["since_s"] == pytest.approx(30.0, abs=10.0)
    site.core.peers.arrived(ClientName("jackal1"), now=clock.now() - 5.0)
    age_s = site.state.to_json()[0]["age_s"]
    assert isinstance(age_s, float) and age_s >= 5.0
    # The own hop's round trip is not known yet, so the whole way's is not either.
    assert rows["jackal1"]["round_trip_s"] is None and rows["jackal1"]["round_trip_to"] == "relay"
    site.core.link.lane.flight.rtt.sample(0.1, now=clock.now())
    assert site.state.to_json()[0]["round_trip_s"] == pytest.approx(0.14)
    assert site.state.to_json()[0]["round_trip_to"] == "jackal1"
    site.state.close()


@pytest.mark.usefixtures("still")
async def test_who_is_given_up_is_said_and_stays_away(caplog: pytest.LogCaptureFixture) -> None:
    site = Site()
    site.state.start()
    site.told("jackal1", up=False, for_s=600.0)
    site.core.peers.told({"t": "peers", "peers": [{"name": "jackal1"}]}, now=clock.now())
    (line,) = [record for record in caplog.records if "given up" in record.message]
    assert line.levelname == "WARNING"
    assert line.message.startswith("jackal1 is given up by the relay after 600 s")
    assert site.state.detail() == "1 of 1 peers away: jackal1 is gone for 600 s (given up by the relay)"
    rows = [(row["peer"], row["status"], row["given_up"]) for row in site.state.to_json()]
    assert rows == [("jackal1", "gone", True)]
    await until(lambda: "/jackal1/sern/link" in site.endpoint.open, "its state stays published")
    opened = site.endpoint.open["/jackal1/sern/link"]
    assert decoded(opened).level == 2 and "given up by the relay" in decoded(opened).message
    site.told("jackal1", up=True)
    await until(lambda: decoded(opened).level == 0, "it is back")
    assert [record.message for record in caplog.records][-1].startswith("jackal1 is back after")
    assert [row["given_up"] for row in site.state.to_json()] == [False]
    site.state.close()


@pytest.mark.parametrize("given_up", [False, True])
async def test_who_is_forgotten_is_said_once_if_it_was_gone(caplog: pytest.LogCaptureFixture, given_up: bool) -> None:
    site = Site()
    site.state.start()
    for name in ("jackal1", "jackal2"):
        site.told(name, up=True)
    await until(lambda: "/jackal1/sern/link" in site.endpoint.open, "its state is published")
    site.told("jackal1", up=False)
    if given_up:
        site.core.peers.told({"t": "peers", "peers": [{"name": "jackal1", "here": False}]}, now=clock.now())
    site.core.peers.subscribed((), now=clock.now())
    for name in ("jackal1", "jackal2"):
        site.core.peers.told({"t": "peers", "peers": [{"name": name, "here": name == "jackal2"}]}, now=clock.now())
    assert site.state.to_json() == [] and site.state.detail() == ""
    (line,) = [record for record in caplog.records if "forgotten" in record.message]
    assert line.levelname == "WARNING" and line.message.startswith("jackal1 is forgotten after ")
    await until(lambda: list(site.endpoint.open) == ["/sern/link"], "its topic ends, long before the next period")
    site.state.close()


@pytest.mark.usefixtures("still")
async def test_topics_are_withdrawn_when_nothing_was_heard_for_so_long_and_come_back() -> None:
    site = Site(withdraw_after_s=5.0)
    site.state.start()
    site.told("quiet", up=False, for_s=10.0)
    site.told("late", up=False, for_s=10.0)
    site.told("fresh", up=False, for_s=1.0)
    site.told("there", up=True, for_s=10.0)
    site.core.peers.arrived(ClientName("late"), now=clock.now())
    site.core.peers.arrived(ClientName("there"), now=clock.now() - 100.0)
    await until(lambda: site.withdrawn.names, "one is withdrawn")
    assert site.withdrawn.names == {"quiet"}
    site.told("quiet", up=True)
    await until(lambda: not site.withdrawn.names, "it is back")
    site.state.close()


# --- withdrawal -------------------------------------------------------------------------------------------------------


class Stream:
    def __init__(self, endpoint: Endpoint, name: str, kept: Kept | None = None) -> None:
        self.info = ros_types.topic_info(name, "std_msgs/msg/String", Encoding.ROS1)
        self.publisher: Publisher | None = endpoint.advertise(self.info)
        self.kept = kept
        self.withdrawn: ClientName | None = None

    def use(self, publisher: Publisher | None) -> None:
        self.publisher = publisher


def _close(stream: Any) -> None:
    stream.publisher.close()


def test_what_is_latched_is_published_again_when_its_origin_is_back(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = Endpoint()
    streams: dict[StreamId, Any] = {}
    withdrawal = Withdrawal(streams, endpoint.advertise, _close, used=True)

    def info(origin: str, name: str, *, latched: bool, depth: int = 1) -> StreamInfo:
        identity = StreamId(ClientName(origin), 1, TopicName(name))
        topic = TopicInfo(identity.topic, "std_msgs/msg/String", Encoding.ROS1)
        return StreamInfo(identity, topic, spec(latched=latched, depth=depth))

    map_ = info("jackal1", "/jackal1/map", latched=True, depth=2)
    kept = withdrawal.kept(map_)
    assert kept is not None and kept.maxlen == 2
    assert withdrawal.kept(info("a", "/a", latched=False)) is None
    most = withdrawal.kept(info("a", "/b", latched=True, depth=10_000))
    assert most is not None and most.maxlen == MAX_KEPT
    for number in range(3):
        kept.append((b"%d" % number, number))
    streams[map_.id] = Stream(endpoint, "/jackal1/map", kept)
    odom = info("jackal1", "/jackal1/odom", latched=False)
    streams[odom.id] = Stream(endpoint, "/jackal1/odom")
    other = info("jackal2", "/jackal2/odom", latched=False)
    streams[other.id] = Stream(endpoint, "/jackal2/odom")

    withdrawal.withdraw(ClientName("jackal1"))
    withdrawal.withdraw(ClientName("jackal1"))
    assert list(endpoint.open) == ["/jackal2/odom"]
    assert [record.message for record in caplog.records] == [
        "jackal1 is not there: 2 of its topics end here until it is"
    ]
    endpoint.refused = {"/jackal1/odom"}
    withdrawal.restore(ClientName("jackal1"))
    assert endpoint.open["/jackal1/map"].bodies == [b"1", b"2"]
    assert "/jackal1/odom cannot be published again" in caplog.text and streams[odom.id].withdrawn == "jackal1"
    endpoint.refused.clear()
    withdrawal.restore(ClientName("jackal1"))
    withdrawal.restore(ClientName("jackal1"))
    assert set(endpoint.open) == {"/jackal1/map", "/jackal1/odom", "/jackal2/odom"}


def test_nothing_is_kept_where_nothing_is_withdrawn() -> None:
    withdrawal = Withdrawal({}, Endpoint().advertise, _close, used=False)
    identity = StreamId(ClientName("a"), 1, TopicName("/a"))
    stream = StreamInfo(identity, TopicInfo(identity.topic, "std_msgs/msg/String", Encoding.ROS1), spec(latched=True))
    assert withdrawal.kept(stream) is None


async def test_a_message_of_who_is_not_there_brings_its_topic_back() -> None:
    """The bridge itself: what was latched comes first, nothing twice, and its tables are those of the endpoint."""
    endpoint: Any = Endpoint()
    shell = Shell()
    bridge = bridge_of(endpoint, shell=shell, withdraws=True)
    withdrawal = bridge.inbound.withdrawal
    identity = StreamId(ClientName("jackal1"), 1, TopicName("/jackal1/map"))
    info = ros_types.topic_info("/jackal1/map", "std_msgs/msg/String", Encoding.ROS1, latched=True)
    stream = StreamInfo(identity, info, spec(latched=True))
    bridge.stream_opened(stream)
    bridge.message(stream, Message(identity, 1, b"old", 1, clock.now()), now=clock.now())
    withdrawal.withdraw(ClientName("jackal1"))
    assert endpoint.open == {}
    bridge.message(stream, Message(identity, 2, b"new", 2, clock.now()), now=clock.now())
    assert endpoint.open["/jackal1/map"].bodies == [b"old", b"new"]
    withdrawal.withdraw(ClientName("jackal1"))
    withdrawal.restore(ClientName("jackal1"))
    assert endpoint.open["/jackal1/map"].bodies == [b"new"]
    withdrawal.withdraw(ClientName("jackal1"))
    bridge.stream_closed(stream)
    withdrawal.restore(ClientName("jackal1"))
    assert endpoint.open == {} and shell.faults == []
    bridge.close()
