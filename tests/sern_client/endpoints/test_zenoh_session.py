"""The configuration of a session, and what is dropped on the way to zenoh and from it. Without a network."""

import asyncio
import json
import sys
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import pytest

pytest.importorskip("zenoh", reason="the library eclipse-zenoh is missing: pip install 'sern[zenoh]'")

from sern_client.endpoints.base import Held, ServiceInfo
from sern_client.endpoints.common.handover import ITEM_BYTES
from sern_client.endpoints.zenoh import names
from sern_client.endpoints.zenoh import session as module
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.session import SessionOptions, load_zenoh, make_config
from sern_client.sections import make_section
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.config import endpoints as sections
from sern_tools.ports import free_ports
from tests.support import DEADLINE_S, Events, until


async def test_a_writer_that_is_behind_drops_the_oldest_messages_and_no_news(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_WAITING_BYTES", 30)
    endpoint = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(), listen=("tcp/127.0.0.1:0",))))
    done: list[str] = []
    session = endpoint.session
    session.put(lambda: done.append("end of one"), 0)
    for number in range(6):
        session.put(lambda number=number: done.append(f"message {number}"), 10)  # type: ignore[misc]
    session.put(lambda: done.append("end of another"), 0)
    assert endpoint.drops == {DropReason.QUEUE_FULL: 3}

    def refused() -> None:
        raise session.zenoh.ZError("the session is closed")

    session.put(refused, 0)  # an end of something that is gone
    session.put(refused, 10)
    await endpoint.start(Events())
    try:
        await until(lambda: endpoint.drops == {DropReason.QUEUE_FULL: 4, DropReason.DISCONNECTED: 1})
        assert done == ["end of one", "message 4", "message 5", "end of another"]
    finally:
        await endpoint.stop()


async def test_a_loop_that_is_behind_counts_what_it_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(), listen=("tcp/127.0.0.1:0",))))
    await endpoint.start(Events())
    try:
        monkeypatch.setattr(endpoint.session.handover.messages, "max_bytes", 115)
        for _ in range(3):
            endpoint.session.handover.put(lambda: None, 10)
        await asyncio.sleep(0)
        assert endpoint.drops == {DropReason.QUEUE_FULL: 2}
    finally:
        await endpoint.stop()


def test_without_the_library_the_command_is_named_that_installs_it_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another pip would put it beside SERN, or refuse to."""
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(ConfigError) as raised:
        load_zenoh()
    assert str(raised.value) == f"needs the zenoh library: {sys.executable} -m pip install eclipse-zenoh"


def configured(options: SessionOptions) -> dict[str, Any]:
    """The keys of zenoh's configuration that these tests are about."""
    config = make_config(load_zenoh(), options)
    return {key: json.loads(config.get_json(key)) for key in ("mode", "id", "connect/endpoints", "listen/endpoints")}


@pytest.mark.parametrize(
    ("listen", "comes_to", "listens"),
    [
        ("tcp/0.0.0.0:7450", ["tcp/127.0.0.1:7450"], ["tcp/0.0.0.0:0"]),
        ("tcp/[::]:7450#iface=eth0", ["tcp/[::1]:7450#iface=eth0"], ["tcp/[::]:0#iface=eth0"]),
        ("udp/10.0.0.7:7450", ["udp/10.0.0.7:7450"], ["udp/10.0.0.7:0"]),
        ("tcp/127.0.0.1:0", [], ["tcp/127.0.0.1:0"]),
        ("unixsock-stream//run/zenoh", ["unixsock-stream//run/zenoh"], []),
        ("serial//dev/ttyS0#baudrate=9600", [], []),
    ],
)
def test_a_second_session_takes_no_locator_of_the_first(listen: str, comes_to: list[str], listens: list[str]) -> None:
    there = "tcp/router.example:7447"
    found = configured(SessionOptions(connect=(there,), listen=(listen,), second=True))
    assert found["connect/endpoints"] == [there, *comes_to]
    assert found["listen/endpoints"] == listens


def test_a_second_session_of_a_file_is_another_one_in_the_mode_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "session.json5"
    file.write_text('{id: "abc1", mode: "client"}')
    found = configured(
        SessionOptions(connect=("tcp/a:1",), listen=("tcp/127.0.0.1:7450",), config_file=file, second=True)
    )
    assert found["mode"] == "client"
    assert found["id"] not in (None, "abc1")
    assert found["connect/endpoints"] == ["tcp/a:1"], "a client has one way, and it leads to the router"
    assert found["listen/endpoints"] == ["tcp/127.0.0.1:0"]


FILE = '{mode: "peer", connect: {endpoints: ["tcp/of.the.file:1"]}, listen: {endpoints: ["tcp/127.0.0.1:7451"]}}'


def of_section(tmp_path: Path, **said: Any) -> dict[str, Any]:
    """What a section of the client's file makes of the session."""
    section = sections.ZenohEndpoint.model_validate_json(json.dumps({"kind": "zenoh", **said}))
    endpoint = make_section(section, tmp_path.joinpath)
    assert isinstance(endpoint, ZenohEndpoint)
    return configured(endpoint.options.session)


@pytest.mark.parametrize(
    ("said", "connect", "listen"),
    [
        ({}, ["tcp/of.the.file:1"], ["tcp/127.0.0.1:7451"]),
        ({"connect": ["tcp/a:2"]}, ["tcp/a:2"], ["tcp/127.0.0.1:7451"]),
        ({"listen": ["tcp/127.0.0.1:7452"]}, ["tcp/of.the.file:1"], ["tcp/127.0.0.1:7452"]),
        ({"listen": []}, ["tcp/of.the.file:1"], ["tcp/localhost:0"]),
    ],
)
def test_locators_of_the_file_hold_unless_the_section_has_others(
    tmp_path: Path, said: dict[str, Any], connect: list[str], listen: list[str]
) -> None:
    (tmp_path / "session.json5").write_text(FILE)
    found = of_section(tmp_path, config_file="session.json5", **said)
    assert found["connect/endpoints"] == connect
    assert found["listen/endpoints"] == listen


def test_without_a_file_and_locators_a_session_is_one_of_rmw_zenoh(tmp_path: Path) -> None:
    found = of_section(tmp_path)
    assert found["connect/endpoints"] == ["tcp/localhost:7447"]
    assert found["listen/endpoints"] == ["tcp/localhost:0"]


async def test_the_router_of_the_file_is_the_one_that_is_said_to_be_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("sern_client.endpoints.zenoh.endpoint.ROUTER_WAIT_S", 0.0)
    file = tmp_path / "session.json5"
    (nobody,) = free_ports(1)
    file.write_text(
        f'{{mode: "peer", connect: {{endpoints: ["tcp/127.0.0.1:{nobody}"], exit_on_failure: false, timeout_ms: -1}}, '
        'listen: {endpoints: ["tcp/127.0.0.1:0"]}, scouting: {multicast: {enabled: false}}}'
    )
    endpoint = ZenohEndpoint(ZenohOptions(SessionOptions(config_file=file)))
    await endpoint.start(Events())
    try:
        await until(lambda: f"nobody answers at tcp/127.0.0.1:{nobody}; is the router" in caplog.text, "said")
    finally:
        await endpoint.stop()


class Two(NamedTuple):
    """Endpoints that reach each other, and what each of them announces."""

    one: ZenohEndpoint
    other: ZenohEndpoint
    events: Events
    other_events: Events


@pytest.fixture
async def two() -> AsyncIterator[Two]:
    """One that listens, and one that comes to it."""
    (port,) = free_ports(1)
    here, there = f"tcp/127.0.0.1:{port}", "tcp/127.0.0.1:0"
    one = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(), listen=(here,)), accept_bridged=True))
    other = ZenohEndpoint(ZenohOptions(SessionOptions(connect=(here,), listen=(there,)), accept_bridged=True))
    made = Two(one, other, Events(), Events())
    await one.start(made.events)
    other.watch_services(made.other_events)
    await other.start(made.other_events)
    yield made
    await other.stop()
    await one.stop()


async def test_an_attachment_counts_for_what_waits(two: Two, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = two.one, two.other
    info = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.CDR)
    there.advertise(info)
    await until(lambda: info.name in two.events.infos)
    got: list[bytes] = []

    def sink(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    here.subscribe(info.name, sink)
    handover = here.session.handover
    monkeypatch.setattr(handover, "_wakes", lambda: False)  # the loop is busy
    key = names.data_key(0, info.name, names.dds_type(info.type_name), info.type_hash)

    def arrived() -> bool:
        """Until the two have met, what is published is for nobody: again and again."""
        there.session.opened.put(key, b"", attachment=bytes(60_000))
        return bool(handover.messages)

    await until(arrived)
    with handover._lock:  # more of them may be arriving
        assert handover.messages.nbytes == len(handover.messages) * (60_000 + ITEM_BYTES)
    handover._run()
    await until(lambda: b"" in got)


async def test_a_request_that_is_dropped_is_refused(two: Two, monkeypatch: pytest.MonkeyPatch) -> None:
    """More have arrived than the loop serves: the oldest is told at once, and does not wait for its timeout."""
    server, caller = two.one, two.other
    lamp = ServiceInfo(TopicName("/lamp"), "std_srvs/srv/SetBool", Encoding.CDR, "RIHS01_" + "5" * 64)

    async def echo(request: bytes) -> bytes:
        return request

    server.serve(lamp, echo)
    await until(lambda: lamp.name in two.other_events.services)
    assert await caller.call(lamp.name, b"first", timeout_s=DEADLINE_S) == b"first"
    handover = server.session.handover
    monkeypatch.setattr(handover.messages, "max_bytes", 1)
    monkeypatch.setattr(handover, "_wakes", lambda: False)  # the loop is busy
    calls = list[asyncio.Task[bytes]]()
    for word in (b"one", b"two"):
        calls.append(asyncio.create_task(caller.call(lamp.name, word, timeout_s=DEADLINE_S)))
        await until(lambda: handover.messages and handover.dropped == len(calls) - 1)
    with pytest.raises(ServiceError, match="/lamp: the bridge is behind"):
        await calls[0]
    assert not calls[1].done() and server.drops == {DropReason.QUEUE_FULL: 1}
    handover._run()
    assert await calls[1] == b"two"


async def test_what_nobody_wants_is_not_taken_from_the_session(two: Two) -> None:
    here, there = two.one, two.other
    info = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.CDR)
    kind = names.dds_type(info.type_name), info.type_hash
    publisher = there.advertise(info)
    await until(lambda: info.name in two.events.infos)
    got: list[bytes] = []

    def sink(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    subscription = here.subscribe(info.name, sink)
    matching = there.session.opened.declare_publisher(here.node.key(info.name, *kind))
    await until(lambda: there.readers(info.name, *kind) == 1 and matching.matching_status.matching)
    publisher.publish(b"wanted", 1)
    await until(lambda: got == [b"wanted"])

    here.interest(info.name, False)
    await until(lambda: there.readers(info.name, *kind) == 0 and not matching.matching_status.matching)
    publisher.publish(b"unwanted", 2)
    written = Event()
    there.session.put(written.set, 0)  # after it, in the thread that writes
    await until(written.is_set)
    held = Held(subscriptions=Counter([info.name]))
    assert here.validate(held) == [] and info.name in two.events.infos, "it is offered all the same"

    here.interest(info.name, True)
    await until(lambda: there.readers(info.name, *kind) == 1 and matching.matching_status.matching)
    publisher.publish(b"again", 3)
    await until(lambda: len(got) == 2)
    assert got == [b"wanted", b"again"]
    subscription.close()
    await until(lambda: there.readers(info.name, *kind) == 0)
    assert here.validate(Held()) == []


async def test_what_is_latched_is_there_when_it_is_wanted_again(two: Two) -> None:
    here, there = two.one, two.other
    info = ros_types.topic_info("/map", "std_msgs/msg/String", Encoding.CDR, latched=True)
    publisher = there.advertise(info)
    publisher.publish(b"one", 1)
    await until(lambda: info.name in two.events.infos)
    got: list[bytes] = []

    def sink(body: bytes, _stamp_ns: int) -> bool:
        got.append(body)
        return True

    here.subscribe(info.name, sink)
    here.interest(info.name, False)
    await until(lambda: got == [b"one"])
    publisher.publish(b"two", 2)
    await until(lambda: got == [b"one", b"two"], "what is latched is taken for whoever comes")
    here.interest(info.name, True)
    publisher.publish(b"three", 3)
    await until(lambda: len(got) == 3)
    assert got == [b"one", b"two", b"three"], "each once"
