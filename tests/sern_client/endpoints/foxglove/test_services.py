"""Services of other sites, called by viewers; and what viewers are told in words."""

import asyncio

import pytest

from sern_client.endpoints.base import ServiceInfo
from sern_client.endpoints.foxglove import news, services
from sern_client.endpoints.foxglove.news import Episodes
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_services
from tests.support import Events, until
from tests.viewers import bridge, viewer


def service(encoding: Encoding, type_name: str = "std_srvs/srv/SetBool") -> ServiceInfo:
    return ServiceInfo(TopicName("/jackal1/lights"), type_name, encoding, "")


@pytest.mark.parametrize(
    ("encoding", "type_name"), [(Encoding.CDR, "std_srvs/srv/SetBool"), (Encoding.ROS1, "std_srvs/SetBool")]
)
async def test_a_service_is_called(encoding: Encoding, type_name: str) -> None:
    asked: list[bytes] = []

    async def handler(request: bytes) -> bytes:
        asked.append(request)
        if request == b"bad":
            raise ServiceError("the lights are broken")
        return b"answer"

    async with bridge() as run, viewer(run.port) as person:
        server = run.endpoint.serve(service(encoding), handler)
        await until(lambda: person.services)
        told = person.services["/jackal1/lights"]
        assert told["type"] == type_name
        text = ros_services.resolve("std_srvs/srv/SetBool", "", encoding).request.text.definition
        assert (told["request"]["encoding"], told["request"]["schema"]) == (encoding, text)
        await person.call("/jackal1/lights", 1, b"ask", encoding)
        await person.call("/jackal1/lights", 2, b"bad", encoding)
        await person.call("/jackal1/lights", 3, b"{}", "json")
        await until(lambda: len(person.answers) == 3)
        assert person.answers[1] == b"answer" and sorted(asked) == [b"ask", b"bad"]
        assert "the lights are broken" in str(person.answers[2])
        assert isinstance(person.answers[3], str)
        with pytest.raises(ConfigError, match="viewers have a service of that name"):
            run.endpoint.serve(service(encoding), handler)
        server.close()
        await until(lambda: not person.services)
        run.endpoint.serve(service(encoding), handler)
        await until(lambda: person.services)


async def test_calls_that_are_not_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(services, "CALL_S", 0.05)
    waiting = asyncio.Event()

    async def handler(request: bytes) -> bytes:
        if request == b"wait":
            waiting.set()
        await asyncio.Event().wait()
        return b""

    async with bridge() as run, viewer(run.port) as person:
        server = run.endpoint.serve(service(Encoding.CDR), handler)
        await until(lambda: person.services)
        await person.call("/jackal1/lights", 1, b"late")
        await until(lambda: 1 in person.answers)
        assert "/jackal1/lights did not answer within 0.05 s" in str(person.answers[1])
        monkeypatch.setattr(services, "CALL_S", 60.0)
        await person.call("/jackal1/lights", 2, b"wait")
        await waiting.wait()
        server.close()
        await until(lambda: 2 in person.answers)
        assert "went while it was called" in str(person.answers[2])


async def test_services_that_cannot_be_served() -> None:
    async def handler(request: bytes) -> bytes:
        return request

    async with bridge() as run:
        with pytest.raises(ConfigError, match="service type own_srvs/srv/Thing is unknown here"):
            run.endpoint.serve(service(Encoding.CDR, "own_srvs/srv/Thing"), handler)
        with pytest.raises(ConfigError, match="raw requests"):
            run.endpoint.serve(service(Encoding.RAW), handler)
        run.endpoint.watch_services(Events())
        with pytest.raises(ServiceError, match="no viewer offers a service"):
            await run.endpoint.call(TopicName("/x"), b"", timeout_s=1.0)


def test_an_episode_is_told_when_it_changes_and_not_too_often() -> None:
    episodes = Episodes()
    assert episodes.update("/a", 100, now=0.0) is None, "what was before anybody looked is no news"
    told = episodes.update("/a", 103, now=1.0)
    assert told is not None and told.startswith("3 since ")
    assert episodes.update("/a", 110, now=2.0) is None, "not so soon again"
    assert episodes.update("/a", 110, now=7.0) == told.replace("3 since", "10 since")
    assert episodes.update("/a", 110, now=20.0) is None
    assert episodes.over(now=20.0) == []
    assert episodes.over(now=2.0 + news.CALM_S) == ["/a"]
    again = episodes.update("/a", 111, now=50.0)
    assert again is not None and again.startswith("1 since ")
    assert episodes.keep(["/b"]) == ["/a"]
    assert (episodes.update("/c", 4, now=0.0, first=0) or "").startswith("4 since ")


async def test_what_did_not_come_is_told_with_its_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(news, "LOOK_S", 0.01)
    monkeypatch.setattr(news, "TELL_S", 0.0)
    async with bridge() as run, viewer(run.port) as person:
        run.viewed.set("/points", 0.1, lifespan=5)
        run.viewed.set("/odom", 0.1)
        assert run.endpoint.drops == {}
        await until(lambda: run.viewed.asked > 3)
        assert person.statuses == {}
        run.viewed.set("/points", 0.1, lifespan=7, superseded=1)
        await until(lambda: person.statuses)
        ((status, text),) = person.statuses.items()
        assert status == "sern/dropped/points"
        assert text.startswith("/points: 3 since ") and text.endswith(" did not come (lifespan 7, superseded 1 in all)")
        async with viewer(run.port) as late:
            await until(lambda: late.statuses == person.statuses)
            del run.viewed.news["/points"]
            await until(lambda: not late.statuses and not person.statuses, "it is taken back")


async def test_a_topic_that_its_site_thins_says_so_while_it_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(news, "LOOK_S", 0.01)
    async with bridge() as run, viewer(run.port) as person:
        run.viewed.set("/odom", None, capped_hz=2.5)
        asked = run.viewed.asked
        await until(lambda: run.viewed.asked > asked + 3)
        assert person.statuses == {}, "nobody looks at it"
        run.viewed.set("/odom", 0.1, capped_hz=2.5)
        await until(lambda: person.statuses)
        assert person.statuses == {
            "sern/capped/odom": "/odom comes 2.5 times a second at most: its site thins it (max_rate_hz there)"
        }
        run.viewed.set("/odom", 0.1)
        await until(lambda: not person.statuses, "it is thinned no more")


async def test_a_status_is_taken_back_when_it_is_calm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(news, "LOOK_S", 0.01)
    monkeypatch.setattr(news, "CALM_S", 0.05)
    async with bridge() as run, viewer(run.port) as person:
        run.viewed.set("/points", 0.1)
        await until(lambda: run.viewed.asked > 2)
        run.viewed.set("/points", 0.1, **{DropReason.TOO_SLOW: 2})
        await until(lambda: any(said["op"] == "removeStatus" for said in person.said))
        assert not person.statuses
