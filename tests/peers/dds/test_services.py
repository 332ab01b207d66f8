"""Services as rmw_cyclonedds has them, against Fast DDS with the same messages, and between two endpoints."""

import asyncio
import logging
import struct

import pytest

from sern_client.endpoints.base import ServiceInfo
from sern_client.endpoints.dds import services
from sern_client.endpoints.dds.services import Wrapped
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_services
from tests.peers.dds.conftest import MakeEndpoint, MakePeer
from tests.support import DEADLINE_S, until

CDR = Encoding.CDR
NAME = TopicName("/set_bool")
SET_BOOL = "std_srvs/srv/SetBool"
REQUEST, REPLY = "std_srvs::srv::dds_::SetBool_Request_", "std_srvs::srv::dds_::SetBool_Response_"
HEAD = b"\x00\x01\x00\x00"
YES = HEAD + b"\x01"
RESPONSE = HEAD + b"\x01" + bytes(3) + struct.pack("<I", 4) + b"yes\0"


def service(name: TopicName = NAME) -> ServiceInfo:
    text = ros_services.resolve(SET_BOOL, "", CDR).text
    return ServiceInfo(name, SET_BOOL, CDR, text.type_hash, text.definition)


@pytest.mark.parametrize("body", [YES, RESPONSE, HEAD, b"\x00\x00\x00\x00\x00\x07"])
def test_the_header_of_a_call(body: bytes) -> None:
    wrapped = Wrapped.join(body, 2**63 + 5, -3)
    order = "<" if body[1] else ">"
    assert wrapped == body[:4] + struct.pack(f"{order}Qq", 2**63 + 5, -3) + body[4:]
    assert Wrapped.split(wrapped) == (body, 2**63 + 5, -3)
    with pytest.raises(ValueError, match="no request or reply"):
        Wrapped.split(wrapped[:19])


async def test_we_call_their_server(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    await peer.do("serve s set_bool userdata=serviceid=1.2.3;")
    await until(lambda: NAME in recorder.services)
    assert recorder.services[NAME] == service()
    await endpoint.call(NAME, HEAD + b"\0", timeout_s=DEADLINE_S)  # the two know each other then, both ways
    answers = await asyncio.gather(
        *(endpoint.call(NAME, HEAD + bytes([number % 2]), timeout_s=DEADLINE_S) for number in range(20))
    )
    for number, answer in enumerate(answers):
        text = b"yes\0" if number % 2 else b"no\0"
        expected = HEAD + bytes([number % 2, 0, 0, 0]) + struct.pack("<I", len(text)) + text
        assert answer[: len(expected)] == expected
    await peer.do("close s")
    await until(lambda: NAME not in recorder.services)
    with pytest.raises(ServiceError, match="no such service"):
        await endpoint.call(NAME, YES, timeout_s=1)


async def test_they_call_our_server(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    asked: list[bytes] = []

    async def handler(request: bytes) -> bytes:
        asked.append(request)
        if request[4] == 0:
            raise ServiceError("it is not to be")
        return RESPONSE

    server = endpoint.serve(service(), handler)
    await peer.do(f"sub answers rr/set_boolReply {REPLY} reliable userdata=clientid=7.8;")
    await peer.do(f"pub calls rq/set_boolRequest {REQUEST} reliable userdata=clientid=7.8;")
    await peer.line("matched answers 1")
    await peer.line("matched calls 1")
    await until(lambda: server.reader is not None and server.reader.matched == 1)
    await until(lambda: server.writer is not None and server.writer.matched == 1)
    for number, value in enumerate((1, 0, 1)):
        await peer.do(f"write calls {(HEAD + struct.pack('<Qq', 99, number) + bytes([value])).hex()}")
    await peer.line("got answers ", 1)
    answers = peer.got("answers")
    for number, answer in zip((0, 2), answers, strict=True):
        expected = HEAD + struct.pack("<Qq", 99, number) + RESPONSE[4:]
        assert answer[: len(expected)] == expected
    assert [request[:5] for request in asked] == [YES, HEAD + b"\0", YES]
    assert recorder.services == {}  # our own are never announced
    server.close()
    server.close()
    await peer.line("matched answers 0")


async def test_between_two_endpoints(domain: int, make_endpoint: MakeEndpoint) -> None:
    """A SERN endpoint beside another sees its services only when told to."""
    one, _ = await make_endpoint(domain, node_name="one")
    _, beside = await make_endpoint(domain, node_name="two")
    chained, recorder = await make_endpoint(domain, node_name="three", accept_bridged=True)

    async def handler(request: bytes) -> bytes:
        await asyncio.sleep(0)
        return RESPONSE

    server = one.serve(service(), handler)
    await until(lambda: NAME in recorder.services)
    assert (await chained.call(NAME, YES, timeout_s=DEADLINE_S))[: len(RESPONSE)] == RESPONSE
    assert beside.services == {}
    server.close()
    await until(lambda: NAME not in recorder.services)


async def test_no_answer_in_time(domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint) -> None:
    peer = await make_peer(domain)
    endpoint, recorder = await make_endpoint(domain)
    await peer.do(f"sub in rq/set_boolRequest {REQUEST} reliable userdata=serviceid=1;")
    await peer.do(f"pub out rr/set_boolReply {REPLY} reliable userdata=serviceid=1;")
    await until(lambda: NAME in recorder.services)
    with pytest.raises(ServiceError, match=r"/set_bool: no answer within 0\.05 s"):
        await endpoint.call(NAME, YES, timeout_s=0.05)
    await peer.do("close out")
    await until(lambda: NAME not in recorder.services)


async def test_requests_beyond_the_limit_are_counted(
    domain: int, make_endpoint: MakeEndpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services, "MAX_CALLS", 2)
    one, _ = await make_endpoint(domain, node_name="one")
    other, recorder = await make_endpoint(domain, node_name="two", accept_bridged=True)
    release = asyncio.Event()

    async def handler(request: bytes) -> bytes:
        await release.wait()
        return RESPONSE

    server = one.serve(service(), handler)
    await until(lambda: NAME in recorder.services)
    calls = [asyncio.create_task(other.call(NAME, YES, timeout_s=DEADLINE_S)) for _ in range(3)]
    await until(lambda: one.drops == {DropReason.QUEUE_FULL: 1})
    release.set()
    await until(lambda: sum(call.done() for call in calls) == 2)
    assert all(call.result()[: len(RESPONSE)] == RESPONSE for call in calls if call.done())
    for call in calls:
        call.cancel()
    await asyncio.gather(*calls, return_exceptions=True)
    server.close()


async def test_a_call_that_is_told_how_it_ends_answers_before_its_service_is_gone(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint
) -> None:
    peer = await make_peer(domain)
    endpoint, _ = await make_endpoint(domain)
    outcome: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
    asked = asyncio.Event()

    async def handler(request: bytes) -> bytes:
        asked.set()
        return await outcome

    server = endpoint.serve(service(), handler)
    await peer.do(f"sub answers rr/set_boolReply {REPLY} reliable userdata=clientid=7.8;")
    await peer.do(f"pub calls rq/set_boolRequest {REQUEST} reliable userdata=clientid=7.8;")
    await peer.line("matched answers 1")
    await peer.line("matched calls 1")
    await until(lambda: server.reader is not None and server.reader.matched == 1)
    await until(lambda: server.writer is not None and server.writer.matched == 1)
    await peer.do(f"write calls {(HEAD + struct.pack('<Qq', 99, 1) + bytes([1])).hex()}")
    await asyncio.wait_for(asked.wait(), DEADLINE_S)
    outcome.set_result(RESPONSE)
    server.close()
    await peer.line("got answers ")
    await peer.line("matched answers 0")


async def test_a_service_of_rmw_fastrtps_is_left_alone(
    domain: int, make_peer: MakePeer, make_endpoint: MakeEndpoint, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing in its USER_DATA says that it puts the call's number in its messages."""
    peer = await make_peer(domain)
    with caplog.at_level(logging.ERROR):
        endpoint, recorder = await make_endpoint(domain)
        await peer.do("serve s set_bool")
        await until(lambda: any("rmw_fastrtps" in record.message for record in caplog.records))
    (line,) = [record.message for record in caplog.records]
    assert "service /set_bool" in line and "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp" in line
    assert recorder.services == {}
    with pytest.raises(ServiceError, match="no such service"):
        await endpoint.call(NAME, YES, timeout_s=1)


async def test_what_cannot_be_served(domain: int, make_endpoint: MakeEndpoint) -> None:
    endpoint, _ = await make_endpoint(domain)

    async def handler(request: bytes) -> bytes:
        return request

    with pytest.raises(ConfigError, match="type_paths"):
        endpoint.serve(ServiceInfo(NAME, "no_srvs/srv/Such", CDR, ""), handler)
    with pytest.raises(ConfigError, match="ros1 bodies"):
        endpoint.serve(ServiceInfo(NAME, SET_BOOL, Encoding.ROS1, ""), handler)
