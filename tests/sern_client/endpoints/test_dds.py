"""The parts of the dds endpoint that need no peer: names, policies, the graph, settings, and its queues."""

import ctypes
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="the dds endpoint needs cyclonedds: pip install cyclonedds==11.0.1")

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.qos import _CQos

from sern_client.endpoints.dds import names, raw
from sern_client.endpoints.dds.definitions import Definitions
from sern_client.endpoints.dds.domain import (
    HEARTBEAT_MS,
    DomainOptions,
    close_domain,
    environment_domain,
    open_domain,
)
from sern_client.endpoints.dds.graph import Remote, puts_header
from sern_client.endpoints.dds.names import Role, RosName
from sern_client.endpoints.dds.qos import (
    EndpointQos,
    mismatches,
    read_qos,
    reader_for,
    to_policies,
    writer_for,
)
from sern_client.endpoints.dds.raw import INFINITE_NS
from sern_client.endpoints.dds.services import new_service_id
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_installation, ros_types
from sern_runtime.ros_types import topic_info
from tests.exploring import cases

STEADY = settings(max_examples=cases(100))
QOS = st.builds(
    EndpointQos,
    reliable=st.booleans(),
    durability=st.integers(0, 3),
    deadline_ns=st.sampled_from([10**8, 10**9, INFINITE_NS]),
    lifespan_ns=st.sampled_from([10**8, INFINITE_NS]),
    liveliness=st.integers(0, 2),
    lease_ns=st.sampled_from([10**9, INFINITE_NS]),
    exclusive=st.booleans(),
)


@pytest.mark.parametrize(
    ("topic", "name"),
    [
        ("rt/odom", RosName(Role.TOPIC, TopicName("/odom"))),
        ("rt/a/b/c", RosName(Role.TOPIC, TopicName("/a/b/c"))),
        ("rq/ns/set_boolRequest", RosName(Role.REQUEST, TopicName("/ns/set_bool"))),
        ("rr/set_boolReply", RosName(Role.REPLY, TopicName("/set_bool"))),
    ],
)
def test_topic_names(topic: str, name: RosName) -> None:
    assert names.from_dds(topic) == name
    assert names.to_dds(name.name, name.role) == topic


@pytest.mark.parametrize(
    "topic", ["odom", "ros_discovery_info", "rx/odom", "rt", "rt/", "rq/Request", "rq/odom", "rr/odomRequest", "rt/a b"]
)
def test_topics_that_are_not_of_ros(topic: str) -> None:
    assert names.from_dds(topic) is None


def test_type_names() -> None:
    assert names.type_to_dds("nav_msgs/msg/Odometry") == "nav_msgs::msg::dds_::Odometry_"
    assert names.type_from_dds("nav_msgs::msg::dds_::Odometry_") == "nav_msgs/msg/Odometry"
    assert names.type_from_dds("nav_msgs::msg::Odometry") is None


@given(st.binary(max_size=60))
@STEADY
def test_user_data_is_whatever_it_is(data: bytes) -> None:
    pairs = names.read_user_data(data)
    assert all(isinstance(key, str) and "=" not in key for key in pairs)


def test_user_data() -> None:
    data = names.user_data(typehash="RIHS01_00", clientid="1.2")
    assert data == b"typehash=RIHS01_00;clientid=1.2;"
    assert names.read_user_data(data + b"odd;;x") == {"typehash": "RIHS01_00", "clientid": "1.2"}


@given(offered=QOS, asked=QOS)
@STEADY
def test_what_is_asked_for_because_of_writers_matches_them(offered: EndpointQos, asked: EndpointQos) -> None:
    both = [replace(offered, exclusive=False), replace(asked, exclusive=False)]
    common = reader_for(both)
    assert all(not mismatches(writer, common) for writer in both)
    assert common.reliable == (offered.reliable and asked.reliable)
    assert mismatches(offered, offered) == []


def through_dds(policies: Qos) -> raw.Announced:
    """What a peer would read of these policies."""
    there = _CQos.qos_to_cqos(policies)
    try:
        return raw.announced(ctypes.cast(there, ctypes.c_void_p).value or 0)
    finally:
        _CQos.delete_cqos(there)


def test_threads_read_policies_beside_each_other() -> None:
    """The binding's own way mixes them up, and frees what another thread has."""

    def read(number: int) -> set[tuple[str, bytes, int, tuple[str, ...]]]:
        policies = Qos(
            Policy.EntityName(f"peer{number}"),
            Policy.Userdata(f"typehash={number};".encode()),
            Policy.Deadline(number + 1),
            Policy.Partition([f"first{number}", f"second{number}"]),
        )
        there = _CQos.qos_to_cqos(policies)
        try:
            address = ctypes.cast(there, ctypes.c_void_p).value or 0
            found = [raw.announced(address) for _ in range(2000)]
        finally:
            _CQos.delete_cqos(there)
        return {(one.name, one.user_data, one.deadline_ns, one.partitions) for one in found}

    with ThreadPoolExecutor(4) as threads:
        for number, found in enumerate(threads.map(read, range(4))):
            partitions = (f"first{number}", f"second{number}")
            assert found == {(f"peer{number}", f"typehash={number};".encode(), number + 1, partitions)}


def test_what_is_read_of_policies_is_freed(monkeypatch: pytest.MonkeyPatch) -> None:
    freed: list[Any] = []
    free = _CQos.free

    def counted(what: Any) -> None:
        freed.append(bool(what))
        free(what)

    monkeypatch.setattr(_CQos, "free", counted)
    through_dds(Qos(Policy.EntityName("a"), Policy.Userdata(b"b"), Policy.Partition(["c", "d"])))
    assert freed == [True] * 5  # the name, the data, the partitions and their list


def test_policies_that_are_not_announced() -> None:
    assert through_dds(Qos()) == raw.Announced("", b"", False, 0, INFINITE_NS, INFINITE_NS, 0, INFINITE_NS, False, ())


@given(QOS)
@STEADY
def test_policies_are_read_as_they_are_written(qos: EndpointQos) -> None:
    wanted = replace(qos, durability=min(qos.durability, 1), liveliness=0, lease_ns=INFINITE_NS, type_hash="RIHS01_1")
    assert read_qos(through_dds(to_policies(wanted, depth=3, writer=True))) == wanted


def test_policies_of_others() -> None:
    policies = Qos(
        Policy.Reliability.BestEffort,
        Policy.Durability.Persistent,
        Policy.Liveliness.ManualByTopic(10**9),
        Policy.Deadline(5),
        Policy.Partition(["a", "b"]),
        Policy.Userdata(b"serviceid=1.2;"),
    )
    qos = read_qos(through_dds(policies))
    assert (qos.reliable, qos.durability, qos.liveliness, qos.lease_ns, qos.deadline_ns) == (False, 3, 2, 10**9, 5)
    assert qos.partitions == ("a", "b") and qos.service_id == "1.2"
    assert mismatches(qos, EndpointQos()) == ["partition"]
    asked = replace(qos, partitions=())
    assert [line.split(" (")[0] for line in mismatches(EndpointQos(), asked)] == [
        "durability", "deadline", "liveliness", "liveliness lease",
    ]  # fmt: skip


@pytest.mark.parametrize("reliable", [None, True, False])
@pytest.mark.parametrize("latched", [False, True])
def test_what_a_stream_is_offered_with(reliable: bool | None, latched: bool) -> None:
    """Reliable always: a subscriber asks for that unless told otherwise, and would get nothing."""
    info = TopicInfo(TopicName("/x"), "a/msg/B", Encoding.CDR, latched=latched, reliable=reliable, lifespan_s=1.0)
    qos = writer_for(info, lifespan=False)
    assert (qos.reliable, qos.transient_local, qos.lifespan_ns) == (True, latched, INFINITE_NS)
    assert writer_for(info, lifespan=True).lifespan_ns == 10**9


def test_who_puts_the_number_of_a_call_into_its_messages() -> None:
    other = Remote(UUID(int=5), UUID(int=3), True, "rt/chat", "T", EndpointQos())
    fast = replace(other, guid=UUID(bytes=b"\x01\x0f" + bytes(14)))
    assert puts_header(other)
    assert not puts_header(fast)
    assert puts_header(replace(fast, qos=EndpointQos(service_id="1.2")))
    assert len(new_service_id().split(".")) == 16


def test_settings_become_xml() -> None:
    assert "<Interfaces>" not in DomainOptions().to_xml()
    assert f">{HEARTBEAT_MS}ms</HeartbeatInterval>" in DomainOptions().to_xml()
    text = DomainOptions(localhost_only=True, lease_s=2.5).to_xml()
    for part in ('name="lo"', "<AllowMulticast>false", '<Peer address="127.0.0.1"/>', "62000B", "2500ms", "4194304B"):
        assert part in text
    text = DomainOptions(interface="10.0.0.5", peers=("robot", "a&b"), multicast=True, fragment_bytes=1400).to_xml()
    for part in ('address="10.0.0.5"', "<AllowMulticast>true", '"robot"', '"a&amp;b"', "1400B"):
        assert part in text


def test_one_domain_has_one_configuration(domain_id: int) -> None:
    options = DomainOptions(domain_id, localhost_only=True)
    open_domain(options)
    open_domain(options)
    with pytest.raises(ConfigError, match="used twice with different settings"):
        open_domain(replace(options, lease_s=3.0))
    close_domain(domain_id)
    close_domain(domain_id)
    open_domain(replace(options, lease_s=3.0))
    close_domain(domain_id)


def test_settings_that_cyclone_dds_refuses(
    domain_id: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "<Domain><General><NoSuchThing>1</NoSuchThing></General></Domain>")
    with pytest.raises(ConfigError, match=f"DDS domain {domain_id} cannot be opened.*CYCLONEDDS_URI") as caught:
        open_domain(DomainOptions(domain_id))
    assert "\n" not in str(caught.value)
    assert "NoSuchThing" in capfd.readouterr().err


@pytest.fixture
def domain_id() -> int:
    from tests.peers.dds.peer import free_domain

    return free_domain()


@pytest.mark.parametrize(("text", "number"), [("", 0), ("7", 7), (" 42 ", 42), ("232", 232)])
def test_the_environment_names_a_domain(text: str, number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    assert environment_domain() == number


@pytest.mark.parametrize("text", ["-1", "233", "x", "1.5"])
def test_the_environment_names_no_domain(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(ConfigError, match="ROS_DOMAIN_ID"):
        environment_domain()


def test_definitions_by_hash(tmp_path: Path) -> None:
    folder = tmp_path / "share" / "std_msgs"
    (folder / "msg").mkdir(parents=True)
    (folder / "msg" / "String.msg").write_text("string data\nint8 more\n")
    known = topic_info("/x", "std_msgs/msg/String", Encoding.CDR)
    types = Definitions([tmp_path])
    own = types.message("std_msgs/msg/String")
    assert own.definition == "string data\nint8 more\n"
    assert types.message("std_msgs/msg/String", own.type_hash) == own
    assert types.message("std_msgs/msg/String", known.type_hash).definition == known.definition
    with pytest.raises(ConfigError, match=f"RIHS01_0, but the definition known here has {own.type_hash} and RIHS01"):
        types.message("std_msgs/msg/String", "RIHS01_0")
    with pytest.raises(ConfigError, match="unknown here"):
        types.service("no_srvs/srv/Such")
    assert types.service("std_srvs/srv/Trigger").definition.startswith("---\n")


def test_definitions_of_what_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is sourced comes before an installation beside it, unless its hash is another; type_paths before both."""
    texts = {"sourced": "int8 a\n", "jazzy": "int8 b\n", "own": "int8 c\n"}
    for name, text in texts.items():
        folder = tmp_path / name / "share" / "robot_msgs" / "msg"
        folder.mkdir(parents=True)
        (folder / "Lamp.msg").write_text(text)
        (folder / "Old.msg").write_text("int8 x\n" if name == "jazzy" else "nowhere_msgs/Thing x\n")
        (tmp_path / name / "share" / "ament_index").mkdir()
    noetic = tmp_path / "noetic" / "share" / "robot_msgs" / "msg"
    noetic.mkdir(parents=True)
    (noetic / "Lamp.msg").write_text("int8 ros1\n")
    found = [(tmp_path / "sourced",), (tmp_path / "jazzy",)]
    environment = {"AMENT_PREFIX_PATH": str(tmp_path / "sourced")}
    assert ros_installation.overlays(environment, tmp_path)[0] == found[0]
    assert found[1] in ros_installation.overlays(environment, tmp_path)
    assert (tmp_path / "noetic",) not in ros_installation.overlays(environment, tmp_path)
    monkeypatch.setattr(ros_installation, "overlays", lambda: found)
    hashes = {name: ros_types.hash_of("robot_msgs/msg/Lamp", text, Encoding.CDR) for name, text in texts.items()}

    installed = Definitions(())
    assert installed.message("robot_msgs/msg/Lamp").definition == texts["sourced"], "the nearest"
    for name in ("sourced", "jazzy"):
        assert installed.message("robot_msgs/msg/Lamp", hashes[name]).definition == texts[name]
    with pytest.raises(ConfigError, match="add the directory with the right version"):
        installed.message("robot_msgs/msg/Lamp", hashes["own"])
    with pytest.raises(ConfigError, match="uses nowhere_msgs/msg/Thing"):
        installed.message("robot_msgs/msg/Old")
    old = ros_types.hash_of("robot_msgs/msg/Old", "int8 x\n", Encoding.CDR)
    assert installed.message("robot_msgs/msg/Old", old).definition == "int8 x\n", "the place before has it broken"
    assert Definitions([tmp_path / "own"]).message("robot_msgs/msg/Lamp").definition == texts["own"]
    for name in ("../msg/Lamp", "robot_msgs/../Lamp", "robot_msgs/msg/../../Lamp"):
        with pytest.raises(ConfigError):
            installed.message(name)


async def test_a_loop_that_is_too_slow_loses_the_oldest(domain_id: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Writer and reader in two domain participants of this process; the loop does not run while they are busy."""
    from sern_client.endpoints.dds import endpoint
    from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
    from tests.support import Events, Patience, until

    monkeypatch.setattr(endpoint, "LEARN_S", 0.0)  # nobody is waited for
    domain = DomainOptions(domain_id, localhost_only=True)
    one = DdsEndpoint(DdsOptions(domain))
    two = DdsEndpoint(DdsOptions(domain, accept_bridged=True, queue_depth=5))
    heard = Events()
    await one.start(Events())
    await two.start(heard)
    try:
        info = topic_info("/chat", "std_msgs/msg/String", Encoding.CDR, reliable=True)
        publisher = one.advertise(replace(info, depth=200))
        await until(lambda: info.name in heard.infos)  # its graph has the writer a little earlier
        got: list[bytes] = []

        def sink(body: bytes, stamp_ns: int) -> bool:
            got.append(body)
            return True

        subscription = two.subscribe(info.name, sink)
        await until(lambda: publisher.writer.matched == 1)
        bodies = [b"\0\x01\0\0\x04\0\0\0" + b"%03d\0" % number for number in range(100)]
        assert not publisher.waits  # what is published goes out at once
        for body in bodies:
            publisher.publish(body, 1)
        patience = Patience()
        while two.entities.overruns() < 50 and not patience.over():
            pass  # the loop is busy with something else
        await until(lambda: bodies[-1] in got)
        assert two.entities.overruns() + len(got) == 100 and two.entities.overruns() >= 50
        assert got == sorted(got)
        subscription.close()
        assert two.entities.overruns() >= 50
    finally:
        await two.stop()
        await one.stop()


@pytest.mark.parametrize("counts", [[0], [8], [9, 9], [9, 17, 17], [17, 3]])
def test_readers_that_come_while_they_are_counted_are_counted(counts: list[int]) -> None:
    """Discovery runs on threads of its own: from one answer to the next there may be more of them, or fewer."""

    class Writer:
        _ref = 7
        asked = 0

        def _get_matched_subscriptions(self, ref: int, handles: Any, room: int) -> int:
            assert ref == self._ref
            count = counts[self.asked]
            self.asked += 1
            for number in range(min(room, count)):
                handles[number] = -1 - number  # signed, as the binding has them
            return count

    writer: Any = Writer()
    assert raw.matched_readers(writer) == [2**64 - 1 - number for number in range(counts[-1])]


def test_a_writer_that_is_gone_has_no_readers_to_name() -> None:
    class Writer:
        _ref = 7

        def _get_matched_subscriptions(self, ref: int, handles: Any, room: int) -> int:
            return -3

    writer: Any = Writer()
    with pytest.raises(OSError, match=r"does not say whom .* is matched with \(return code -3\)"):
        raw.matched_readers(writer)


def test_a_writer_is_deleted_on_the_thread_that_may_wait() -> None:
    """However quick that thread is: deleting waits for slow readers, and the event loop must not."""
    from sern_client.endpoints.dds.entities import Writer

    deleted_on: list[str] = []

    class Entity:
        def __del__(self) -> None:
            deleted_on.append(threading.current_thread().name)

    class Endpoint:
        def close_writer(self, writer: Writer, kept: list[Any]) -> None:
            worker = threading.Thread(target=kept.clear, name="worker")
            worker.start()
            worker.join()

    endpoint: Any = Endpoint()
    entity: Any = Entity()
    writer = Writer(endpoint, entity, UUID(int=1), stamped=False)
    del entity
    writer.close()
    assert deleted_on == ["worker"]


@pytest.mark.parametrize("refusals", [1, 2])
async def test_a_topic_that_is_just_being_deleted_is_made_anew(
    domain_id: int, monkeypatch: pytest.MonkeyPatch, refusals: int
) -> None:
    """The worker deletes it with its last reader or writer; until that is done it is found, and of no use."""
    from sern_client.endpoints.dds import entities
    from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions

    topics: list[Any] = []

    def refuse(publisher: Any, topic: Any, policies: Any) -> Any:
        topics.append(topic)
        if len(topics) <= refusals:
            raise DDSException(DDSException.DDS_RETCODE_BAD_PARAMETER)
        return DataWriter(publisher, topic, policies)

    class Silent:
        def topic_added(self, info: TopicInfo) -> None: ...

        def topic_removed(self, name: TopicName) -> None: ...

    one = DdsEndpoint(DdsOptions(DomainOptions(domain_id, localhost_only=True)))
    await one.start(Silent())
    try:
        monkeypatch.setattr(entities, "DataWriter", refuse)
        info = topic_info("/chat", "std_msgs/msg/String", Encoding.CDR)
        if refusals == 1:
            one.advertise(info)
        else:
            with pytest.raises(ConfigError, match="rt/chat: no writer"):
                one.advertise(info)
        assert len(topics) == 2 and topics[0] is not topics[1]
    finally:
        await one.stop()
