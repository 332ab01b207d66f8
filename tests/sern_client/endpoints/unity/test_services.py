"""Services of other sites that scenes call, and services that scenes offer."""

import asyncio
from collections import Counter

import pytest

from sern_client.endpoints.base import ServiceInfo
from sern_client.endpoints.unity.commands import MAX_SRV_ID
from sern_client.endpoints.unity.endpoint import UnityEndpoint
from sern_client.endpoints.unity.faults import Fault
from sern_client.endpoints.unity.own_services import OwnServices
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_services
from tests.sern_client.endpoints.unity.conftest import Started
from tests.sern_client.endpoints.unity.scene import PlayedScene
from tests.support import Events, until

SWITCH = TopicName("/switch")
ON, DONE = b"\0\1\0\0\1", b"\0\1\0\0\1\0\0\0\1\0\0\0\0"
"""A request and a response of std_srvs/SetBool; of ROS 1 they are without the first four bytes."""


def service(
    name: str = SWITCH, type_name: str = "std_srvs/srv/SetBool", encoding: Encoding = Encoding.CDR
) -> ServiceInfo:
    text = ros_services.resolve(type_name, "", encoding).text
    return ServiceInfo(TopicName(name), type_name, encoding, text.type_hash, text.definition)


class Far:
    """A service of another site: `handler` answers what `answer` says, once it does."""

    def __init__(self) -> None:
        self.requests: list[bytes] = []
        self.answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self.cancelled = 0

    async def handler(self, request: bytes) -> bytes:
        self.requests.append(request)
        try:
            return await asyncio.shield(self.answer)
        except asyncio.CancelledError:
            self.cancelled += 1
            raise


async def called(scene: PlayedScene, srv_id: int, name: str = SWITCH, body: bytes = ON) -> None:
    await scene.command("__request", srv_id=srv_id)
    await scene.message(name, body)


async def registered(scene: PlayedScene, name: str = SWITCH, type_name: str = "std_srvs/SetBool") -> None:
    await scene.command("__ros_service", topic=name, message_name=type_name)


# --- services of other sites ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ros2", [True, False])
@pytest.mark.parametrize("piece_bytes", [None, 1])
async def test_a_scene_calls(started: Started, port: int, ros2: bool, piece_bytes: int | None) -> None:
    endpoint = await started(protocol="ros2" if ros2 else "ros1")
    far = Far()
    request, response = (ON, DONE) if ros2 else (ON[4:], DONE[4:])
    far.answer.set_result(response)
    served = endpoint.serve(service(encoding=endpoint.encoding), far.handler)
    async with PlayedScene(port, ros2=ros2, piece_bytes=piece_bytes) as scene:
        await registered(scene)
        for srv_id in (101, -5, MAX_SRV_ID):
            await called(scene, srv_id, body=request)
        await until(lambda: len(scene.answers("__response")) == 3)
        assert scene.answers("__response") == dict.fromkeys((101, -5, MAX_SRV_ID), (SWITCH, response))
        assert far.requests == [request] * 3
        served.close()
        await called(scene, 7, body=request)
        await scene.told("no site offers the service /switch")
        await until(lambda: scene.answers("__response").get(7) == (SWITCH, b""))


async def test_what_a_scene_says_between_is_not_the_request(started: Started, port: int, events: Events) -> None:
    endpoint = await started()
    far = Far()
    endpoint.serve(service(), far.handler)
    async with PlayedScene(port) as scene:
        await registered(scene)
        await scene.publish("/goal")
        await scene.command("__request", srv_id=1)
        await scene.send(bytes(8))
        await scene.message("/goal", b"\0\1\0\0goal")
        await scene.subscribe("/chat")
        await scene.message(SWITCH, ON)
        await until(lambda: far.requests == [ON])
        assert TopicName("/goal") in events.infos
        await scene.command("__request", srv_id=2)
        await called(scene, 3)
        await scene.told("its request did not come")
        far.answer.set_result(DONE)
        await until(lambda: scene.answers("__response").keys() == {1, 3})


async def test_a_call_that_fails_ends_in_the_scene(started: Started, port: int) -> None:
    endpoint = await started()
    far = Far()
    endpoint.serve(service(), far.handler)
    async with PlayedScene(port) as scene:
        await registered(scene)
        await called(scene, 1)
        await until(lambda: far.requests)
        far.answer.set_exception(ServiceError("/switch did not answer within 5 s"))
        await scene.told("/switch did not answer within 5 s")
        await until(lambda: scene.answers("__response") == {1: (SWITCH, b"")})
        await called(scene, 2, body=b"\1")
        await scene.told("no body of cdr")
        await called(scene, 3, "/other")
        await scene.told("'/other' was not registered")
        await until(lambda: scene.answers("__response").keys() == {1, 2, 3})
        await scene.command("__remove_ros_service", topic=SWITCH)
        await called(scene, 4)
        await scene.told("'/switch' was not registered")
        assert endpoint.faults.counts == {Fault.CALL: 1, Fault.BODY: 1, Fault.NOT_REGISTERED: 2}


async def test_an_empty_answer_is_not_given_where_it_would_be_one(started: Started, port: int) -> None:
    endpoint = await started()
    far = Far()
    far.answer.set_exception(ServiceError("refused"))
    endpoint.serve(service("/empty", "std_srvs/srv/Empty"), far.handler)
    async with PlayedScene(port) as scene:
        await registered(scene, "/empty", "std_srvs/Empty")
        await called(scene, 1, "/empty", b"\0\1\0\0\0")
        await scene.told("refused")
        await scene.caught_up()
        assert not scene.answers("__response")
    assert far.answer.exception() is not None


async def test_a_scene_that_goes_ends_its_calls_and_one_that_stays_hears_of_an_end(started: Started, port: int) -> None:
    endpoint = await started()
    far = Far()
    served = endpoint.serve(service(), far.handler)
    async with PlayedScene(port) as stays:
        await registered(stays)
        await called(stays, 1)
        async with PlayedScene(port) as goes:
            await registered(goes)
            await called(goes, 1)
            await until(lambda: len(far.requests) == 2)
        await until(lambda: far.cancelled == 1)
        served.close()
        await stays.told("the service /switch has gone")
        await until(lambda: far.cancelled == 2)
    far.answer.cancel()


async def test_another_service_type_cannot_be_called(started: Started, port: int) -> None:
    endpoint = await started()
    endpoint.serve(service(), Far().handler)
    async with PlayedScene(port) as scene:
        await registered(scene, type_name="std_srvs/Trigger")
        assert "std_srvs/SetBool" in await scene.told("std_srvs/Trigger")
        await called(scene, 1)
        await scene.told("was not registered")
        await registered(scene, "/gadget", "my_msgs/Turn")
        await scene.told("my_msgs/Turn")
        assert endpoint.faults.counts[Fault.UNKNOWN_TYPE] == 1


async def test_what_cannot_be_served_is_refused_to_the_bridge(started: Started) -> None:
    endpoint = await started()
    far = Far()
    with pytest.raises(ConfigError, match="ros1 service"):
        endpoint.serve(service(encoding=Encoding.ROS1), far.handler)
    endpoint.serve(service(), far.handler)
    with pytest.raises(ConfigError, match="another service of that name"):
        endpoint.serve(service(), far.handler)
    definition = endpoint.service_definition("std_srvs/srv/SetBool", Encoding.ROS1)
    assert definition is not None and definition.startswith("bool data")


# --- services of scenes --------------------------------------------------------------------------------------------


async def offered(scene: PlayedScene, name: str = SWITCH, type_name: str = "std_srvs/SetBool") -> None:
    await scene.command("__unity_service", topic=name, message_name=type_name)


async def asked(scene: PlayedScene, count: int = 1) -> list[int]:
    """The numbers of the calls of the scene, once there are so many."""
    await until(lambda: len(scene.answers("__request")) >= count)
    return list(scene.answers("__request"))


async def answer(scene: PlayedScene, srv_id: int, name: str = SWITCH, body: bytes = DONE) -> None:
    await scene.command("__response", srv_id=srv_id)
    await scene.message(name, body)


@pytest.mark.parametrize("ros2", [True, False])
@pytest.mark.parametrize("piece_bytes", [None, 1])
async def test_a_scene_serves(started: Started, port: int, events: Events, ros2: bool, piece_bytes: int | None) -> None:
    endpoint = await started(protocol="ros2" if ros2 else "ros1")
    request, response = (ON, DONE) if ros2 else (ON[4:], DONE[4:])
    async with PlayedScene(port, ros2=ros2, piece_bytes=piece_bytes) as scene:
        await offered(scene, "switch")
        await until(lambda: SWITCH in events.services)
        assert events.services[SWITCH] == service(encoding=endpoint.encoding)
        calls = [asyncio.create_task(endpoint.call(SWITCH, request, timeout_s=60)) for _ in range(2)]
        first, second = await asked(scene, 2)
        assert scene.answers("__request") == dict.fromkeys((first, second), ("switch", request))
        await answer(scene, second, "switch", response)
        assert await calls[1] == response
        await answer(scene, first, "switch", response + b"!")
        assert await calls[0] == response + b"!"
        await scene.command("__remove_unity_service", topic="switch")
        await until(lambda: not events.services)
        with pytest.raises(ServiceError, match="no service /switch"):
            await endpoint.call(SWITCH, request, timeout_s=60)


async def test_an_answer_that_comes_too_late_or_to_no_call(started: Started, port: int) -> None:
    endpoint = await started()
    async with PlayedScene(port) as scene:
        await offered(scene)
        await scene.caught_up()
        with pytest.raises(ServiceError, match=r"did not answer within 0\.01 s"):
            await endpoint.call(SWITCH, ON, timeout_s=0.01)
        (late,) = await asked(scene)
        await answer(scene, late)
        await scene.told("not under way")
        await answer(scene, 4711)
        await scene.caught_up()
        assert endpoint.faults.counts == {Fault.CALL: 2}
        assert endpoint.drops == {DropReason.UNWANTED: 2}
        call = asyncio.create_task(endpoint.call(SWITCH, ON, timeout_s=60))
        number = (await asked(scene, 2))[1]
        await answer(scene, number, body=b"?")
        with pytest.raises(ServiceError, match="no answer that can be read"):
            await call


async def test_a_scene_that_goes_fails_what_it_was_asked(started: Started, port: int, events: Events) -> None:
    endpoint = await started()
    async with PlayedScene(port) as scene:
        await offered(scene)
        await scene.caught_up()
        call = asyncio.create_task(endpoint.call(SWITCH, ON, timeout_s=60))
        await asked(scene)
    with pytest.raises(ServiceError, match="the scene that serves it has gone"):
        await call
    assert not events.services


async def test_of_two_scenes_that_offer_it_the_second_serves_when_the_first_is_gone(
    started: Started, port: int, events: Events
) -> None:
    endpoint = await started()
    async with PlayedScene(port) as second:
        async with PlayedScene(port) as first:
            await offered(first)
            await first.caught_up()
            await offered(second, "/other", "std_srvs/Trigger")
            await offered(second)
            await until(lambda: any("another scene offers /switch" in text for text in second.warnings))
            await offered(second, SWITCH, "std_srvs/Trigger")
            await second.told("std_srvs/Trigger")
            call = asyncio.create_task(endpoint.call(SWITCH, ON, timeout_s=60))
            await answer(first, (await asked(first))[0])
            assert await call == DONE
        await until(lambda: len(endpoint.scenes) == 1)
        assert SWITCH in events.services
        call = asyncio.create_task(endpoint.call(SWITCH, ON, timeout_s=60))
        await answer(second, (await asked(second))[0])
        assert await call == DONE


async def test_a_service_type_that_nobody_knows_is_not_offered(started: Started, port: int, events: Events) -> None:
    await started()
    async with PlayedScene(port) as scene:
        await offered(scene, "/gadget", "my_msgs/Turn")
        assert "type_paths" in await scene.told("my_msgs/Turn")
        assert not events.services


async def test_numbers_of_calls_begin_again_and_leave_out_those_under_way(
    started: Started, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint: UnityEndpoint = await started()
    own = endpoint.own_services = OwnServices(endpoint.types, endpoint.faults, Counter(), first_id=MAX_SRV_ID - 1)
    async with PlayedScene(port) as scene:
        await offered(scene)
        await scene.caught_up()
        calls = [asyncio.create_task(own.call(SWITCH, ON, timeout_s=60)) for _ in range(4)]
        numbers = await asked(scene, 4)
        assert numbers == [MAX_SRV_ID - 1, MAX_SRV_ID, 1, 2]
        for number in numbers:
            await answer(scene, number)
        assert await asyncio.gather(*calls) == [DONE] * 4


async def test_services_that_are_there_are_told_to_who_asks_later(started: Started, port: int) -> None:
    endpoint = await started()
    async with PlayedScene(port) as scene:
        await offered(scene)
        await scene.caught_up()
        later = Events()
        endpoint.watch_services(later)
        assert later.services.keys() == {SWITCH}


async def test_who_offers_what_no_site_is_offered_is_told_so(
    started: Started, port: int, monkeypatch: pytest.MonkeyPatch, events: Events
) -> None:
    await started()
    monkeypatch.setattr(events, "wants_service", lambda name: False)
    async with PlayedScene(port) as scene:
        await offered(scene)
        await until(lambda: any("services.offer" in text for text in scene.warnings))
