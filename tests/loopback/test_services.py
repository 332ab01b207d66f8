"""Services across relay and clients as their user runs them; the endpoints hold services of their own."""

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

from sern_client import daemon as client_daemon
from sern_client.daemon import ClientDaemon
from sern_client.endpoints.base import ServiceHandler, ServiceInfo
from sern_client.services import ServiceBridge
from sern_core.errors import ConfigError, ServiceError
from sern_core.message import TopicInfo, TopicSpec
from sern_core.services import CALL, call_name
from sern_core.types import ClientName, Encoding, TopicName
from sern_runtime.config.client import load_client
from tests.daemons import Lab
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

    async def start_robot(self, **rule: Any) -> ClientDaemon:
        rules = {"offer": [{"match": "/set_.*", **rule}]}
        return await self.lab.connected(
            self.lab.client_file("robot1", {"kind": "synthetic", "role": "robot"}, services=rules)
        )

    async def start_site(
        self, *, name: str = "site", match: str = "/robot1/.*", timeout_s: float = 30.0
    ) -> ClientDaemon:
        rules = {"use": [{"match": match, "timeout_s": timeout_s, "class": "control"}]}
        endpoint = {"kind": "synthetic", "role": "operator"}
        return await self.lab.connected(self.lab.client_file(name, endpoint, services=rules))

    def offer(self) -> None:
        assert self.robot.events is not None
        self.robot.events.service_added(INFO)

    async def served(self, name: TopicName = GLOBAL) -> ServiceHandler:
        await until(lambda: name in self.site.served, f"{name} is served at the site")
        return self.site.served[name].handler


def outcomes(daemon: ClientDaemon) -> dict[tuple[TopicName, str], int]:
    services = daemon.bridge.services
    assert isinstance(services, ServiceBridge)
    return dict(services.outcomes)


async def test_a_call_goes_there_and_its_answer_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        await sites.start_robot()
        site = await sites.start_site()
        sites.offer()
        handler = await sites.served()

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

    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        await sites.start_robot()
        site = await sites.start_site()
        sites.offer()
        handler = await sites.served()
        sites.robot.answer = refuse

        with pytest.raises(ServiceError, match=r"^not with me$"):
            await handler(b"me")
        assert outcomes(site) == {(GLOBAL, "error"): 1}


async def test_a_service_that_does_not_answer_is_an_error_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        await sites.start_robot()
        site = await sites.start_site(timeout_s=0.3)
        sites.offer()
        handler = await sites.served()
        never = asyncio.Event()

        async def wait(request: bytes) -> bytes:
            await never.wait()
            return request

        sites.robot.answer = wait
        with pytest.raises(ServiceError, match=r"did not answer within 0.3 s|took too long"):
            await handler(b"")
        assert sum(outcomes(site).values()) == 1


async def test_a_lost_relay_is_an_error_and_the_call_is_not_executed_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        relay = await lab.relay()
        await sites.start_robot()
        await sites.start_site(timeout_s=0.5)
        sites.offer()
        handler = await sites.served()
        assert await handler(b"before") == b"re: before"

        await lab.drop(relay)
        with pytest.raises(ServiceError):
            await handler(b"lost")
        await lab.relay(tmp_path / "relay.yaml")
        handler = await sites.served()

        async def again() -> bytes:
            try:
                return await handler(b"after")
            except ServiceError:
                return b""

        answer = b""
        while not answer:  # until the sessions are there again; the test's own time limit ends it
            answer = await again()
        assert answer == b"re: after"
        assert [body for _, body in sites.robot.calls if body == b"lost"] == []


async def test_a_service_that_goes_is_withdrawn_and_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        sites = Sites(lab, monkeypatch)
        await lab.relay()
        await sites.start_robot()
        await sites.start_site()
        sites.offer()
        handler = await sites.served()
        started = asyncio.Event()

        async def wait(request: bytes) -> bytes:
            started.set()
            await asyncio.Event().wait()
            return request

        sites.robot.answer = wait
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
        await sites.served()
        expected = {"/robot1/set_speed/_service", "/robot1/set_mode/_service", "/robot1/set_mode/_reply/site"}
        await until(lambda: {stream.topic for stream in robot.core.link.by_stream} == expected, "offered and answered")
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
        forged = TopicInfo(call_name(GLOBAL, ClientName("site")), INFO.type_name, INFO.encoding)
        channel = rogue.core.publish(forged, TopicSpec(), now=time.monotonic())
        honest = TopicInfo(call_name(GLOBAL, ClientName("rogue")), INFO.type_name, INFO.encoding)
        own = rogue.core.publish(honest, TopicSpec(), now=time.monotonic())
        rogue.core.send(channel, CALL.pack(1) + b"forged", 0, now=time.monotonic())
        rogue.core.send(own, CALL.pack(2) + b"own", 0, now=time.monotonic())
        await until(lambda: (SERVICE, b"own") in sites.robot.calls, "its own call is executed")
        assert (SERVICE, b"forged") not in sites.robot.calls
        assert [stream.topic for stream in robot.core.link.by_stream] == [
            "/robot1/set_mode/_service",
            "/robot1/set_mode/_reply/rogue",
        ]


async def test_an_endpoint_without_services_is_named(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "site")
    path = lab.client_file(
        "site", {"kind": "record", "path": "site.bag"}, services={"use": [{"match": "/robot1/set_mode"}]}
    )
    with pytest.raises(ConfigError, match=r"services: an endpoint of kind record has no services"):
        ClientDaemon(load_client(path))
