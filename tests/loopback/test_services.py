"""Services across relay and clients as their user runs them; the endpoints hold services of their own."""

import asyncio
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from sern_client import daemon as client_daemon
from sern_client.daemon import ClientDaemon
from sern_client.endpoints.base import ServiceHandler, ServiceInfo
from sern_client.services import MAX_ERROR_CHARS, ServiceBridge
from sern_core.site.services import CALL, REPLY, call_name, reply_name
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, Reliability, TopicName
from sern_runtime import clock
from sern_runtime.config.client import load_client
from tests.daemons import Lab, topics_out
from tests.fake_services import Services
from tests.support import until

SERVICE = TopicName("/set_mode")
GLOBAL = TopicName("/robot1/set_mode")
INFO = ServiceInfo(
    SERVICE,
    "std_srvs/srv/SetBool",
    Encoding.ROS1,
    "09fb03525b03e7ea1fd3992bafd87e16",
    "bool data\n---\nbool success\nstring message\n",
)


ENDPOINT = {"kind": "synthetic", "role": "operator"}
"""Any that the configuration accepts: the tests put their own in its place."""


class Sites:
    """A robot that offers services and a site that uses them."""

    def __init__(self, lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
        self.lab = lab
        self.ends = {"robot1": Services(), "site": Services()}
        monkeypatch.setattr(client_daemon, "make_endpoint", lambda loaded: self.ends[loaded.model.name])

    @property
    def robot(self) -> Services:
        return self.ends["robot1"]

    @property
    def site(self) -> Services:
        return self.ends["site"]

    async def start_robot(self, **sections: Any) -> ClientDaemon:
        rules = {"offer": [{"match": "/set_.*"}]}
        return await self.lab.connected(self.lab.client_file("robot1", ENDPOINT, services=rules, **sections))

    async def start_site(
        self, *, name: str = "site", match: str = "/robot1/.*", timeout_s: float = 30.0, **sections: Any
    ) -> ClientDaemon:
        rules = {"use": [{"match": match, "timeout_s": timeout_s, "class": "control"}]}
        return await self.lab.connected(self.lab.client_file(name, ENDPOINT, services=rules, **sections))

    async def start(self, **site: Any) -> None:
        self.relay = await self.lab.relay()
        self.robot_daemon = await self.start_robot()
        self.site_daemon = await self.start_site(**site)

    def offer(self) -> None:
        assert self.robot.events is not None
        self.robot.events.service_added(INFO)

    async def served(self, name: TopicName = GLOBAL) -> ServiceHandler:
        await until(lambda: name in self.site.served, f"{name} is served at the site")
        return self.site.served[name].handler


@asynccontextmanager
async def offered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **site: Any
) -> AsyncIterator[tuple[Sites, ServiceHandler]]:
    """A relay, the robot, a site with these options, and what the site serves of the robot's service."""
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await sites.start(**site)
        sites.offer()
        yield sites, await sites.served()


def hold() -> tuple[Callable[[bytes], Awaitable[bytes]], asyncio.Event, asyncio.Event]:
    """A service that tells when it begins and ends when it is let."""
    started, release = asyncio.Event(), asyncio.Event()

    async def answer(request: bytes) -> bytes:
        started.set()
        await release.wait()
        return request

    return answer, started, release


def outcomes(daemon: ClientDaemon) -> dict[tuple[TopicName, str], int]:
    return dict(bridge(daemon).outcomes)


async def test_a_call_goes_there_and_its_answer_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with offered(tmp_path, monkeypatch) as (sites, handler):
        site = sites.site_daemon

        served = sites.site.served[GLOBAL].info
        assert served == ServiceInfo(GLOBAL, INFO.type_name, INFO.encoding, INFO.type_hash, INFO.definition)
        answers = await asyncio.gather(*(handler(b"%d" % number) for number in range(20)))
        assert answers == [b"re: %d" % number for number in range(20)]
        assert sorted(sites.robot.calls) == sorted((SERVICE, b"%d" % number) for number in range(20))
        assert await handler(b"") == b"re: "
        assert await handler(b"x" * 300_000) == b"re: " + b"x" * 300_000
        assert outcomes(site) == {(GLOBAL, "ok"): 22}


async def test_an_error_of_the_service_is_the_callers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def refuse(request: bytes) -> bytes:
        raise ServiceError(f"not with {request.decode()}")

    async with offered(tmp_path, monkeypatch) as (sites, handler):
        site = sites.site_daemon
        sites.robot.answer = refuse

        with pytest.raises(ServiceError, match=r"^not with me$"):
            await handler(b"me")
        assert outcomes(site) == {(GLOBAL, "error"): 1}


async def test_a_call_that_another_site_does_not_want_is_still_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relay reports what one of two sites with the same names turned away, though the other has it."""
    called, go = asyncio.Event(), asyncio.Event()

    async def answer(request: bytes) -> bytes:
        called.set()
        await go.wait()
        return b"re: " + request

    async with offered(tmp_path, monkeypatch) as (sites, handler):
        sites.robot.answer = answer
        services = bridge(sites.site_daemon)
        call = asyncio.ensure_future(handler(b"mine"))
        await until(called.is_set, "the robot has the call")
        calls = services.used[GLOBAL].calls
        assert calls is not None
        services.send_dropped(calls.stream, calls.next_seq - 1, 1, DropReason.UNWANTED)
        go.set()
        assert await call == b"re: mine"


@pytest.mark.parametrize("count", [1, 2, 2**61])
async def test_a_call_in_a_run_of_messages_that_is_dropped_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    async with offered(tmp_path, monkeypatch) as (sites, handler):
        sites.robot.answer, called, _ = hold()
        services = bridge(sites.site_daemon)
        call = asyncio.ensure_future(handler(b"mine"))
        await until(called.is_set, "the robot has the call")
        calls = services.used[GLOBAL].calls
        assert calls is not None
        services.send_dropped(calls.stream, calls.next_seq, count, DropReason.RETENTION)
        assert services.used[GLOBAL].numbers
        services.send_dropped(calls.stream, calls.next_seq - 1, count, DropReason.RETENTION)
        with pytest.raises(ServiceError, match="dropped on its way: retention"):
            await call
        assert not services.used[GLOBAL].numbers


async def test_a_service_that_does_not_answer_is_an_error_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with offered(tmp_path, monkeypatch, timeout_s=0.3) as (sites, handler):
        site = sites.site_daemon
        sites.robot.answer, _, _ = hold()
        # A machine that stood still for that time may not even have brought the call to the robot, and says so.
        with pytest.raises(ServiceError, match=r"did not answer within 0.3 s|took too long|way: (lifespan|retention)$"):
            await handler(b"")
        assert sum(outcomes(site).values()) == 1


async def test_a_lost_relay_is_an_error_and_the_call_is_not_executed_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with offered(tmp_path, monkeypatch, timeout_s=0.5) as (sites, handler):
        relay = sites.relay

        async def again(request: bytes) -> bytes:
            try:
                return await handler(request)
            except ServiceError:
                return b""

        async def answered(request: bytes) -> bytes:
            """A call that has an answer: one that the machine stood still for has none, nor one without a session."""
            answer = b""
            while not answer:  # the test's own time limit ends it
                answer = await again(request)
            return answer

        assert await answered(b"before") == b"re: before"

        await sites.lab.drop(relay)
        with pytest.raises(ServiceError):
            await handler(b"lost")
        await sites.lab.relay(tmp_path / "relay.yaml")
        handler = await sites.served()
        assert await answered(b"after") == b"re: after"
        assert [body for _, body in sites.robot.calls if body == b"lost"] == []


async def test_a_service_that_goes_is_withdrawn_and_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with offered(tmp_path, monkeypatch) as (sites, handler):
        sites.robot.answer, started, _ = hold()
        pending = asyncio.ensure_future(handler(b"one"))
        await started.wait()
        assert sites.robot.events is not None
        sites.robot.events.service_removed(SERVICE)
        with pytest.raises(ServiceError, match="is gone"):
            await pending
        await until(lambda: not sites.site.served, "withdrawn")

        sites.robot.answer = sites.robot.echo
        sites.offer()
        handler = await sites.served()
        assert await handler(b"two") == b"re: two"


async def test_requests_and_responses_are_converted_where_the_sites_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def answer(request: bytes) -> bytes:
        assert request == b"\x01"  # ROS 1: bool data
        return b"\x01" + b"\x02\0\0\0ok"

    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        sites.site.encoding = Encoding.CDR
        await lab.relay()
        await sites.start_robot()
        await sites.start_site()
        sites.offer()
        handler = await sites.served()
        sites.robot.answer = answer
        assert sites.site.served[GLOBAL].info.encoding is Encoding.CDR
        # Little-endian CDR: encapsulation, bool, padding to 4, length with the final zero, text.
        response = await handler(b"\0\x01\0\0\x01")
        assert response[:16] == b"\0\x01\0\0\x01\0\0\0\x03\0\0\0ok\0"
        with pytest.raises(ServiceError, match="cannot be converted"):
            await handler(b"\0\x01")


async def test_only_what_a_rule_names_is_offered_and_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        robot = await sites.start_robot()
        await sites.start_site(match="/robot1/set_mode")
        assert sites.robot.events is not None
        for name in ("/reboot", "/set_speed", "/set_mode"):
            sites.robot.events.service_added(
                ServiceInfo(TopicName(name), INFO.type_name, INFO.encoding, INFO.type_hash)
            )
        handler = await sites.served()
        assert await handler(b"") == b"re: "
        expected = {"/robot1/set_speed/_service", "/robot1/set_mode/_service", "/robot1/set_mode/_reply/site"}
        await until(lambda: set(topics_out(robot)) == expected, "offered and answered")
        assert list(sites.site.served) == [GLOBAL]


async def test_a_type_that_cannot_be_served_stops_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        await sites.start_robot()
        site = await sites.start_site()
        sites.site.refuse = "no such type here"
        sites.offer()
        await until(lambda: "no such type here" in caplog.text, "the refusal is logged")
        assert site.core.link.established
        assert not sites.site.served
        sites.site.refuse = ""


async def test_nobody_calls_in_the_name_of_another_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "site", "rogue") as lab:
        sites = Sites(lab, monkeypatch)
        sites.ends["rogue"] = Services()
        await lab.relay()
        robot = await sites.start_robot()
        rogue = await lab.connected(lab.client_file("rogue", {"kind": "synthetic", "role": "operator"}))
        sites.offer()
        spec = TopicSpec(reliability=Reliability.RELIABLE, lifespan_s=None)  # each is said once, and is to be heard
        forged = TopicInfo(call_name(GLOBAL, ClientName("site")), INFO.type_name, INFO.encoding)
        channel = rogue.core.publish(forged, spec, now=clock.now())
        honest = TopicInfo(call_name(GLOBAL, ClientName("rogue")), INFO.type_name, INFO.encoding)
        own = rogue.core.publish(honest, spec, now=clock.now())
        rogue.core.send(channel, CALL.pack(1) + b"forged", 0, now=clock.now())
        rogue.core.send(own, CALL.pack(2) + b"own", 0, now=clock.now())
        await until(lambda: (SERVICE, b"own") in sites.robot.calls, "its own call is executed")
        assert (SERVICE, b"forged") not in sites.robot.calls
        assert topics_out(robot) == [
            "/robot1/set_mode/_service",
            "/robot1/set_mode/_reply/rogue",
        ]


def bridge(daemon: ClientDaemon) -> ServiceBridge:
    services = daemon.bridge.services
    assert isinstance(services, ServiceBridge)
    return services


def stream_of(name: TopicName, origin: str) -> StreamInfo:
    return StreamInfo(
        StreamId(ClientName(origin), 1, name), TopicInfo(name, INFO.type_name, INFO.encoding), TopicSpec()
    )


async def test_nobody_else_answers_for_a_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with offered(tmp_path, monkeypatch) as (sites, handler):
        services = bridge(sites.site_daemon)
        sites.robot.answer, started, release = hold()
        pending = asyncio.ensure_future(handler(b"one"))
        await started.wait()
        (number,) = services.used[GLOBAL].waiting
        forged = stream_of(reply_name(GLOBAL, ClientName("site")), "rogue")
        services.message(forged, Message(forged.id, 1, REPLY.pack(number, False) + b"forged", 0, clock.now()))
        release.set()
        assert await pending == b"one"


async def test_a_call_whose_caller_leaves_is_not_made_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with offered(tmp_path, monkeypatch, timeout_s=30.0, relay={"udp": False}) as (sites, handler):
        relay = sites.relay
        site = sites.site_daemon
        assert await handler(b"before") == b"re: before"
        await sites.lab.drop(relay)
        # Without a session nothing of a call leaves: one that has been begun, as a probe of silent datagrams, is made.
        await until(lambda: not site.core.link.established, "the link is lost")
        leaves, stays = (asyncio.ensure_future(handler(body)) for body in (b"leaves", b"stays"))
        await until(lambda: len(bridge(site).used[GLOBAL].waiting) == 2, "both wait for the link")
        leaves.cancel()
        await asyncio.gather(leaves, return_exceptions=True)
        await sites.lab.relay(tmp_path / "relay.yaml")
        assert await stays == b"re: stays"
        assert [body for _, body in sites.robot.calls] == [b"before", b"stays"]
        assert outcomes(site) == {(GLOBAL, "ok"): 2, (GLOBAL, "cancelled"): 1}


async def test_a_call_for_an_earlier_process_of_the_robot_is_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with offered(tmp_path, monkeypatch) as (sites, handler):
        robot = sites.robot_daemon
        assert await handler(b"now") == b"re: now"
        (identity,) = bridge(robot).callers
        calls = StreamInfo(identity, TopicInfo(identity.topic, INFO.type_name, INFO.encoding), TopicSpec())
        early_s = bridge(robot).offered[GLOBAL].since_s - 0.01
        bridge(robot).message(calls, Message(identity, 2, CALL.pack(1) + b"early", 0, early_s))
        assert await handler(b"later") == b"re: later"
        assert [body for _, body in sites.robot.calls] == [b"now", b"later"]


@pytest.mark.parametrize(
    ("raised", "shown"),
    [
        ("two\nlines, \x1b[2J and \udc80", "two lines, [2J and"),
        ("x" * 5000, "x" * MAX_ERROR_CHARS),
        ("", "/robot1/set_mode failed, without saying why"),
    ],
)
async def test_error_texts_are_one_bounded_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raised: str, shown: str
) -> None:
    async def fail(request: bytes) -> bytes:
        raise ServiceError(raised)

    async with offered(tmp_path, monkeypatch) as (sites, handler):
        sites.robot.answer = fail
        with pytest.raises(ServiceError) as caught:
            await handler(b"")
        assert str(caught.value) == shown


async def test_what_is_too_large_is_said_to_the_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def long(request: bytes) -> bytes:
        return bytes(200_000)

    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        await sites.start_robot(link={"max_message_bytes": 100_000})
        await sites.start_site(link={"max_message_bytes": 100_000})
        sites.offer()
        handler = await sites.served()
        with pytest.raises(ServiceError, match="dropped on its way: too_large"):
            await handler(bytes(100_001))
        sites.robot.answer = long
        with pytest.raises(ServiceError, match=r"has 200000 bytes, above link\.max_message_bytes of the site .*100000"):
            await handler(b"")
        sites.robot.answer = sites.robot.echo
        assert await handler(b"small") == b"re: small"


async def test_a_robot_that_comes_back_with_another_relay_is_served_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The site still knows the stream of the robot's earlier process, which no relay can tell it of any more."""
    async with offered(tmp_path, monkeypatch) as (sites, first):
        relay = sites.relay
        robot = sites.robot_daemon
        assert await first(b"one") == b"re: one"
        await sites.lab.drop(relay)
        await sites.lab.drop(robot)
        sites.ends["robot1"] = Services()
        await sites.lab.relay(tmp_path / "relay.yaml")
        await sites.start_robot()
        sites.offer()
        await until(lambda: GLOBAL in sites.site.served and sites.site.served[GLOBAL].handler is not first, "again")
        assert await sites.site.served[GLOBAL].handler(b"two") == b"re: two"
        with pytest.raises(ServiceError, match="is gone"):
            await first(b"three")


async def test_two_sites_that_offer_one_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1", "other", "site") as lab:
        sites = Sites(lab, monkeypatch)
        sites.ends["other"] = Services()
        await lab.relay()
        await sites.start_robot()
        offer = {"offer": [{"match": "/set_.*"}]}
        other = lab.client_file("other", ENDPOINT, services=offer, client={"namespace": "/robot1"})
        await lab.connected(other)
        await sites.start_site()
        sites.offer()
        handler = await sites.served()
        events = sites.ends["other"].events
        assert events is not None
        events.service_added(INFO)
        await until(lambda: "robot1 owns that name" in caplog.text, "the second is refused by name")
        assert await handler(b"mine") == b"re: mine"
        assert sites.ends["other"].calls == []


async def test_services_that_come_and_go_leave_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        robot = await sites.start_robot()
        site = await sites.start_site()
        assert sites.robot.events is not None
        for number in range(30):
            sites.offer()
            handler = await sites.served()
            assert await handler(b"%d" % number) == b"re: %d" % number
            sites.robot.events.service_removed(SERVICE)
            await until(lambda: not sites.site.served, "withdrawn")
        await until(
            lambda: not topics_out(robot) and not topics_out(site),
            "no streams are left",
        )
        for services in (bridge(robot), bridge(site)):
            assert not services.offered
            assert not services.used
            assert not services.callers


async def test_many_services_cost_a_stream_each_until_they_are_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = 300
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        robot = await sites.start_robot()
        site = await sites.start_site()
        assert sites.robot.events is not None
        for number in range(count):
            sites.robot.events.service_added(replace(INFO, name=TopicName(f"/set_{number}")))
        await until(lambda: len(sites.site.served) == count, "all are served")
        assert (len(topics_out(robot)), len(topics_out(site))) == (count, 0)
        handler = sites.site.served[TopicName("/robot1/set_7")].handler
        assert await handler(b"seven") == b"re: seven"
        assert (len(topics_out(robot)), len(topics_out(site))) == (count + 1, 1)


async def test_a_site_serves_only_so_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("sern_client.services.MAX_SERVED", 3)
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        await sites.start_robot()
        site = await sites.start_site()
        assert sites.robot.events is not None
        for number in range(6):
            sites.robot.events.service_added(replace(INFO, name=TopicName(f"/set_{number}")))
        await until(lambda: len(site.core.link.taking.streams) == 6 and len(sites.site.served) == 3, "all are known")
        assert len(sites.site.served) == 3
        assert caplog.text.count("name those that are needed in services.use") == 1


CUSTOM = ServiceInfo(SERVICE, "my_robot/srv/SetMode", Encoding.ROS1, "")


async def test_a_type_that_nobody_defines_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        sites.site.encoding = Encoding.CDR
        await lab.relay()
        await sites.start_robot()
        await sites.start_site()
        assert sites.robot.events is not None
        sites.robot.events.service_added(CUSTOM)
        await until(lambda: "cannot be served here" in caplog.text, "it is said")
        (line,) = [record.message for record in caplog.records if "cannot be served here" in record.message]
        assert "/robot1/set_mode of robot1" in line and "my_robot/srv/SetMode" in line and "type_paths" in line
        assert "\n" not in line


async def test_a_definition_that_does_not_come_with_a_service_is_looked_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def answer(request: bytes) -> bytes:
        assert request == b"\x07"
        return b"\x01"

    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        sites.site.encoding = Encoding.CDR
        sites.site.definitions["my_robot/srv/SetMode"] = "uint8 mode\n---\nbool success\n"
        await lab.relay()
        await sites.start_robot()
        await sites.start_site()
        sites.robot.answer = answer
        assert sites.robot.events is not None
        sites.robot.events.service_added(CUSTOM)
        handler = await sites.served()
        assert (await handler(b"\0\x01\0\0\x07"))[:5] == b"\0\x01\0\0\x01"


async def test_the_access_rules_of_the_documentation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[2] / "docs" / "operations.md").read_text()
    section = text.partition("## Services and actions\n")[2].partition("\n## ")[0]
    (example,) = re.findall(r"```yaml\n(access:.*?)```", section, re.DOTALL)
    access = YAML(typ="safe", pure=True).load(example)["access"]
    robot, laptop, other = "jackal1", "laptop", "visitor"
    service = TopicName("/jackal1/set_mode")
    async with Lab(tmp_path, robot, laptop, other) as lab:
        sites = Sites(lab, monkeypatch)
        sites.ends = {name: Services() for name in (robot, laptop, other)}
        await lab.relay(lab.relay_file(access=access))
        offer = {"offer": [{"match": "/.*"}]}
        await lab.connected(lab.client_file(robot, ENDPOINT, services=offer))
        use = {"use": [{"match": "/jackal1/.*"}]}
        for name in (laptop, other):
            await lab.connected(lab.client_file(name, ENDPOINT, services=use))
        events = sites.ends[robot].events
        assert events is not None
        for name in ("/reboot", "/set_mode"):
            events.service_added(replace(INFO, name=TopicName(name)))
        served = sites.ends[laptop].served
        await until(lambda: service in served, "it is served")
        assert await served[service].handler(b"auto") == b"re: auto"
        assert list(served) == [service]
        assert not sites.ends[other].served


async def test_an_endpoint_without_services_is_named(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "site")
    path = lab.client_file(
        "site", {"kind": "record", "path": "site.bag"}, services={"use": [{"match": "/robot1/set_mode"}]}
    )
    with pytest.raises(ConfigError, match=r"services: an endpoint of kind record has no services"):
        ClientDaemon(load_client(path))


RECORDS = [{"kind": "record", "path": "one.bag"}, {"kind": "record", "path": "two.bag"}]


async def test_several_endpoints_without_services_take_actions_of_ros_1(tmp_path: Path) -> None:
    actions = {"use": [{"match": "/robot1/move_base"}]}
    client = ClientDaemon(load_client(Lab(tmp_path, "site").client_file("site", RECORDS, actions=actions)))
    assert client.bridge.services is None
    assert "(?:/robot1/move_base)/result" in client.loaded.model.subscribe_patterns()


async def test_several_endpoints_without_services_are_named(tmp_path: Path) -> None:
    services = {"use": [{"match": "/robot1/set_mode"}]}
    path = Lab(tmp_path, "site").client_file("site", RECORDS, services=services)
    with pytest.raises(ConfigError, match=r"services: an endpoint of kind record has no services"):
        ClientDaemon(load_client(path))
