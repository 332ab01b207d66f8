"""What the dds endpoint makes of what DDS tells of participants, readers and writers."""

import os
from collections import deque
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import InstanceState, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic

from sern_client.endpoints.dds import raw
from sern_client.endpoints.dds.discovery import AT_ONCE, CALLS, MOST_ROUNDS, PARTICIPANTS, READERS, WRITERS, Discovery
from sern_client.endpoints.dds.domain import DomainOptions, close_domain, open_domain
from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
from sern_client.endpoints.dds.graph import Participant, Remote
from sern_client.endpoints.dds.idl import TypeMaker
from sern_client.endpoints.dds.raw import INFINITE_NS, Announced, Change, DiscoveryReader
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from tests.peers.dds.peer import free_domain
from tests.support import Events, until

SAID = Announced("name", b"sern=two;", True, 0, INFINITE_NS, INFINITE_NS, 0, INFINITE_NS, False, ())
SERN = UUID(int=3)


class Script:
    """A source that tells what is put in; of `unreadable` ones it says the number only."""

    def __init__(self) -> None:
        self.changes: deque[Change] = deque()
        self.unreadable = 0
        self.asked = 0

    def take(self, count: int) -> tuple[list[Change], int]:
        self.asked += 1
        found = [self.changes.popleft() for _ in range(min(count, len(self.changes)))]
        unreadable = min(self.unreadable, count - len(found))
        self.unreadable -= unreadable
        return found, unreadable


class Told:
    def __init__(self) -> None:
        self.what: list[tuple[str, UUID]] = []
        self.serns: dict[UUID, str] = {}

    def participant_added(self, participant: Participant) -> None:
        self.what.append(("participant", participant.guid))
        self.serns[participant.guid] = participant.sern

    def participant_removed(self, guid: UUID) -> None:
        self.what.append(("no participant", guid))

    def remote_added(self, remote: Remote) -> None:
        self.what.append(("writer" if remote.writer else "reader", remote.guid))

    def remote_removed(self, guid: UUID) -> None:
        self.what.append(("gone", guid))


@pytest.fixture
def told() -> Told:
    return Told()


@pytest.fixture
def scripts() -> dict[int, Script]:
    return {number: Script() for number in (PARTICIPANTS, WRITERS, READERS)}


@pytest.fixture
def discovery(scripts: dict[int, Script], told: Told) -> Discovery:
    return Discovery(scripts, told)


def change(number: int, *, here: bool = True) -> Change:
    return Change(UUID(int=number), number, SAID if here else None, SERN, "rt/chat", "T")


def tell(discovery: Discovery) -> None:
    while discovery.found:
        discovery.found.popleft()()


@pytest.mark.parametrize(("number", "kind"), [(WRITERS, "writer"), (READERS, "reader")])
def test_whose_it_is_is_told_first(
    discovery: Discovery, scripts: dict[int, Script], told: Told, number: int, kind: str
) -> None:
    """Though DDS says that there are new writers, and not yet that there is a new participant."""
    scripts[number].changes.append(change(10))
    scripts[PARTICIPANTS].changes.append(Change(SERN, 3, SAID, SERN))
    assert discovery.look(number) is False
    tell(discovery)
    assert told.what == [("participant", SERN), (kind, UUID(int=10))] and told.serns == {SERN: "two"}
    scripts[number].changes.append(change(10, here=False))
    scripts[PARTICIPANTS].changes.append(Change(SERN, 3, None, SERN))
    discovery.look(number)
    tell(discovery)
    assert told.what[2:] == [("no participant", SERN), ("gone", UUID(int=10))]


@pytest.mark.parametrize("unreadable", [0, AT_ONCE * CALLS * 3, 7])
def test_one_look_has_an_end(discovery: Discovery, scripts: dict[int, Script], told: Told, unreadable: int) -> None:
    limit = AT_ONCE * CALLS
    scripts[READERS].unreadable = unreadable
    scripts[READERS].changes.extend(change(number) for number in range(3 * limit))
    looks = 1
    while discovery.look(READERS):
        tell(discovery)
        looks += 1
        assert len(told.what) <= limit * looks
    tell(discovery)
    assert looks == (3 * limit + unreadable) // limit + 1
    assert discovery.unreadable == unreadable and len(told.what) == 3 * limit


def test_who_speaks_is_found_before_what_is_said(discovery: Discovery, scripts: dict[int, Script], told: Told) -> None:
    scripts[WRITERS].changes.extend(change(number) for number in range(AT_ONCE * CALLS + 5))
    assert discovery.find_writer(AT_ONCE * CALLS + 2)
    tell(discovery)
    assert ("writer", UUID(int=AT_ONCE * CALLS + 2)) in told.what
    asked = scripts[WRITERS].asked
    discovery.find_writer(4)
    assert scripts[WRITERS].asked == asked  # known
    assert discovery.find_writer(9999)  # there is none, as far as DDS knows
    assert scripts[WRITERS].asked == asked + 1
    scripts[WRITERS].changes.append(change(4, here=False))
    discovery.look(WRITERS)
    discovery.find_writer(4)
    assert scripts[WRITERS].asked == asked + 3


def test_nobody_is_looked_for_without_end(discovery: Discovery, scripts: dict[int, Script]) -> None:
    endless = scripts[WRITERS]
    endless.unreadable = 10**9
    assert not discovery.find_writer(1)
    assert endless.asked == CALLS * MOST_ROUNDS


@pytest.fixture
def participant() -> Any:
    domain = free_domain()
    open_domain(DomainOptions(domain, localhost_only=True))
    yield DomainParticipant(domain, Qos(Policy.EntityName("one"), Policy.Userdata(b"enclave=/;")))
    close_domain(domain)


def string_type() -> Any:
    text = ros_types.describe("std_msgs/msg/String", Encoding.CDR)
    assert text is not None
    return TypeMaker().make(ros_types.resolve("std_msgs/msg/String", text.definition, Encoding.CDR))


BUILTIN = [BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription]


def test_changes_are_read_as_the_binding_reads_them(participant: DomainParticipant) -> None:
    """Which knows the layout of what Cyclone DDS hands out; ours reads the same memory."""
    topics = [Topic(participant, f"rt/t{number}", string_type()) for number in range(3)]
    policies = Qos(Policy.Reliability.Reliable(0), Policy.Deadline(10**9), Policy.Userdata(b"typehash=RIHS01_1;"))
    publisher = Publisher(participant, Qos(Policy.Partition(["a", "b"])))
    used: list[Any] = [DataWriter(publisher, topic, policies) for topic in topics]
    used += [DataReader(Subscriber(participant), topic, policies) for topic in topics[:2]]
    expected = {BUILTIN[0]: 1, BUILTIN[1]: 3, BUILTIN[2]: 2}
    for topic in BUILTIN:
        theirs, ours = BuiltinDataReader(participant, topic), DiscoveryReader(participant, topic)
        theirs._cqos_conv = raw.announced
        found, unreadable = ours.take(2)
        found += ours.take(100)[0]
        samples = theirs.take(100)
        assert unreadable == 0 and ours.take(100) == ([], 0)
        assert all(sample.sample_info.instance_state == InstanceState.Alive for sample in samples)
        assert sorted(found, key=lambda change: change.handle) == sorted(
            (
                Change(
                    sample.key,
                    sample.sample_info.instance_handle,
                    sample.qos,
                    getattr(sample, "participant_key", sample.key),
                    getattr(sample, "topic_name", ""),
                    getattr(sample, "type_name", ""),
                )
                for sample in samples
            ),
            key=lambda change: change.handle,
        )
        assert len(found) >= expected[topic]
    assert {change.participant for change in found} == {participant.guid}
    del used


def test_what_went_and_what_changed(participant: DomainParticipant) -> None:
    ours = DiscoveryReader(participant, BuiltinTopicDcpsPublication)
    topic = Topic(participant, "rt/t", string_type())
    writer = DataWriter(Publisher(participant), topic, Qos(Policy.Userdata(b"a")))
    (came,), _ = ours.take(10)
    assert (came.guid, came.topic, came.type_name) == (writer.guid, "rt/t", "std_msgs::msg::dds_::String_")
    assert came.announced is not None and came.announced.user_data == b"a"
    writer.set_qos(Qos(Policy.Userdata(b"b")))
    (changed,), _ = ours.take(10)
    assert changed.announced is not None and changed.announced.user_data == b"b" and changed.handle == came.handle
    guid = writer.guid
    del writer
    (went,), _ = ours.take(10)
    assert (went.guid, went.announced, went.handle) == (guid, None, came.handle)


def test_a_name_that_is_no_text_leaves_nothing_in_memory(
    participant: DomainParticipant, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What Cyclone DDS hands out is given back whatever is in it, and the others that came with it are read."""

    def resident_bytes() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    ours = DiscoveryReader(participant, BuiltinTopicDcpsPublication)
    cdr_type = string_type()
    bad = Topic(participant, "rt/bad", cdr_type)
    good = Topic(participant, "rt/good", cdr_type)
    policies = Qos(Policy.Userdata(bytes(60_000)))
    publisher = Publisher(participant)
    true_change = ours._change

    def refuse(address: int | None, info: Any) -> Change:
        found = true_change(address, info)
        if found.announced is not None and found.topic == "rt/bad":
            b"rt/\xff".decode()
        return found

    monkeypatch.setattr(ours, "_change", refuse)
    before = 0
    for count in range(300):
        writers = [DataWriter(publisher, topic, policies) for topic in (bad, good)]
        changes, unreadable = ours.take(10)
        assert unreadable == 1 and [change.topic for change in changes] == ["rt/good"]
        writers.clear()
        assert [change.announced for change in ours.take(10)[0]] == [None, None]
        if count == 50:
            before = resident_bytes()
    assert resident_bytes() - before < 8 * 2**20  # 250 of them with 60 kB are 15 MB, with policies of the others 30 MB
    assert "cannot be read: the name b'rt/\\xff'" in caplog.text


async def test_a_participant_changes_what_it_says_of_itself() -> None:
    """Its writer is of this site, of a SERN endpoint, and of this site again; at the end nothing of it is left."""
    options = DomainOptions(free_domain(), localhost_only=True)
    endpoint, heard = DdsEndpoint(DdsOptions(options)), Events()
    await endpoint.start(heard)
    try:
        other = DomainParticipant(options.domain, Qos(Policy.Userdata(b"enclave=/;")))
        writer = DataWriter(Publisher(other), Topic(other, "rt/chat", string_type()), Qos(Policy.Userdata(b"a")))
        await until(lambda: list(heard.infos) == ["/chat"])
        for sern in (b"sern=other;", b"enclave=/sern;"):  # an endpoint of kind dds, one of kind rclpy
            other.set_qos(Qos(Policy.Userdata(sern)))
            await until(lambda: heard.infos == {} and len(endpoint.graph.ignored) == 1)
            other.set_qos(Qos(Policy.Userdata(b"enclave=/;")))
            await until(lambda: list(heard.infos) == ["/chat"] and not endpoint.graph.ignored)
        other.set_qos(Qos(Policy.Userdata(b"enclave=/;")))
        await until(lambda: list(heard.infos) == ["/chat"] and not endpoint.graph.ignored)
        writer.set_qos(Qos(Policy.Userdata(b"typehash=RIHS01_0;")))
        await until(lambda: heard.infos == {})  # nobody knows that version of the type
        writer.set_qos(Qos(Policy.Userdata(b"")))
        await until(lambda: list(heard.infos) == ["/chat"])
        other.set_qos(Qos(Policy.Userdata(b"sern=other;")))
        del writer
        await until(lambda: not endpoint.graph.remotes)
        assert heard.infos == {} and endpoint.drops == {}
        del other
        await until(lambda: endpoint.graph.participants.keys() <= {endpoint.graph.own})
    finally:
        await endpoint.stop()


def test_a_reader_that_is_gone() -> None:
    ours = DiscoveryReader.__new__(DiscoveryReader)
    ours.reader = type("Gone", (), {"_ref": 12345})()
    with pytest.raises(OSError, match=r"does not say who came and went \(return code -"):
        ours.take(3)
