"""What bytes make: connection headers, HTTP messages, TCPROS frames. Accepted, or WireError, nothing else."""

import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_client.endpoints.ros1.frames import SCRATCH_BYTES, Frames
from sern_client.endpoints.ros1.header import MAX_HEADER_BYTES, decode_header, encode_header
from sern_client.endpoints.ros1.http import HttpMessage, HttpReader
from sern_client.endpoints.ros1.xmlrpc import CallError, decode_call, split_uri, value_of
from sern_core.vocabulary.errors import WireError
from tests.exploring import cases

NAMES = st.text(st.characters(codec="utf-8", exclude_characters="="), min_size=1, max_size=20)
FIELDS = st.dictionaries(NAMES, st.text(st.characters(codec="utf-8"), max_size=100), max_size=20)


@given(FIELDS)
def test_headers_come_back(fields: dict[str, str]) -> None:
    encoded = encode_header(fields)
    assert struct.unpack_from("<I", encoded)[0] == len(encoded) - 4
    assert decode_header(encoded[4:]) == fields


@given(st.binary(max_size=200))
def test_any_bytes_are_a_header_or_a_wire_error(body: bytes) -> None:
    try:
        fields = decode_header(body)
    except WireError:
        return
    assert all(name for name in fields)


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        (b"\x01", "left over"),
        (b"\xff\xff\xff\xff", "4294967295"),
        (b"\x03\x00\x00\x00abc", "without a name"),
        (b"\x02\x00\x00\x00=v", "without a name"),
        (b"".join(struct.pack("<I", 4) + b"%03d=" % n for n in range(100)), "more than 64"),
    ],
)
def test_bad_headers_say_why(body: bytes, problem: str) -> None:
    with pytest.raises(WireError, match=problem):
        decode_header(body)


# HTTP

REQUEST = b"POST / HTTP/1.1\r\nHost: a\r\ncontent-LENGTH: 5\r\n\r\nhello"


@pytest.mark.parametrize("step", [1, 7, 1000])
def test_http_in_any_pieces(step: int) -> None:
    reader = HttpReader(max_body_bytes=100, answers=False)
    found: list[HttpMessage] = []
    stream = REQUEST * 3
    for at in range(0, len(stream), step):
        message = reader.feed(stream[at : at + step])
        while message is not None:
            found.append(message)
            message = reader.feed(b"")
    assert [message.body for message in found] == [b"hello"] * 3
    assert found[0].keep_alive and found[0].headers["host"] == "a" and not reader.pending


def test_an_answer_without_length_ends_with_its_connection() -> None:
    reader = HttpReader(max_body_bytes=100, answers=True)
    assert reader.feed(b"HTTP/1.0 200 OK\r\n\r\nall ") is None
    assert reader.feed(b"of it") is None
    message = reader.finish()
    assert message is not None and message.body == b"all of it" and not message.keep_alive


@pytest.mark.parametrize(
    "data",
    [
        b"POST / HTTP/1.1\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: -5\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 101\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 9999999999999999\r\n\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"POST / HTTP/1.1\r\nnonsense\r\n\r\n",
        b"x" * 20_000,
    ],
)
def test_bad_http_is_refused(data: bytes) -> None:
    reader = HttpReader(max_body_bytes=100, answers=False)
    with pytest.raises(WireError):
        reader.feed(data)


@given(st.binary(max_size=300))
def test_any_bytes_are_xml_rpc_or_a_wire_error(body: bytes) -> None:
    with pytest.raises(WireError):
        decode_call(body)


BOMB = b"""<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>
<methodCall><methodName>&b;</methodName></methodCall>"""


@pytest.mark.parametrize(
    "body",
    [
        BOMB,
        b"<methodCall><methodName>a</methodName><params><param><value><int>x</int></value></param></params></methodCall>",
        b"<methodResponse><params><param><value><nonsense/></value></param></params></methodResponse>",
        b"<methodResponse><params>",
    ],
)
def test_hostile_xml_is_refused(body: bytes) -> None:
    with pytest.raises(WireError):
        decode_call(body)


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("<int>1</int>", "not .code, text, value."),
        ("<array><data><value><int>0</int></value><value>no</value><value/></data></array>", "no$"),
        ("<array><data><value>1</value><value/><value/></data></array>", "not .code, text, value."),
    ],
)
def test_answers_that_are_a_no(value: str, problem: str) -> None:
    answer = f"<methodResponse><params><param><value>{value}</value></param></params></methodResponse>"
    with pytest.raises(CallError, match=problem):
        value_of(answer.encode(), "http://x:1", "ask")


@pytest.mark.parametrize("uri", ["", "http://host", "ftp://host:1", "http://host:99999", "http://[::1", "rosrpc://a:1"])
def test_uris_that_lead_nowhere(uri: str) -> None:
    with pytest.raises(CallError):
        split_uri(uri)


# Frames


class Taken(Frames):
    """Fed by hand: no event loop, no socket."""

    def __init__(self, limit: int) -> None:
        super().__init__(limit)
        self.transport = AnyTransport()  # type: ignore[assignment]  # only asked whether it is there
        self.fields: dict[str, str] | None = None
        self.messages: list[bytes] = []
        self.dropped: list[int] = []
        self.problem = ""

    def header(self, fields: dict[str, str]) -> None:
        self.fields = fields

    def message(self, body: bytes) -> None:
        self.messages.append(body)

    def too_large(self, size_bytes: int) -> None:
        self.dropped.append(size_bytes)

    def failed(self, error: WireError) -> None:
        self.problem = str(error)

    def receive(self, data: bytes, pieces: list[int]) -> None:
        """Fill the buffer that is offered, at most a piece at a time, as a transport does."""
        at, turn = 0, 0
        while at < len(data) and self.transport is not None:
            buffer = self.get_buffer(-1)
            count = min(len(buffer), pieces[turn % len(pieces)], len(data) - at)
            buffer[:count] = data[at : at + count]
            self.buffer_updated(count)
            at, turn = at + count, turn + 1


class AnyTransport:
    def abort(self) -> None:
        pass


def framed(*bodies: bytes) -> bytes:
    return b"".join(struct.pack("<I", len(body)) + body for body in bodies)


@settings(max_examples=cases(200))
@given(st.lists(st.binary(max_size=40), max_size=12), st.lists(st.integers(1, 30), min_size=1, max_size=6))
def test_frames_in_any_pieces(bodies: list[bytes], pieces: list[int]) -> None:
    taken = Taken(limit=32)
    taken.receive(encode_header({"topic": "/chat"}) + framed(*bodies), pieces)
    assert taken.fields == {"topic": "/chat"}
    assert taken.messages == [body for body in bodies if len(body) <= 32]
    assert taken.dropped == [len(body) for body in bodies if len(body) > 32]


def test_a_large_frame_is_filled_in_place() -> None:
    taken = Taken(limit=10**7)
    body = bytes(range(256)) * 8000
    taken.receive(encode_header({"a": "b"}) + framed(body, b"next"), [100_000])
    assert taken.messages == [body, b"next"]


def test_a_frame_takes_the_memory_of_what_has_arrived() -> None:
    taken = Taken(limit=64 * 2**20)
    body = bytes(range(251)) * (20 * 2**20 // 251)
    data = encode_header({"a": "b"}) + framed(body)
    begun = len(data) - len(body)
    taken.receive(data[: begun + 1], [100_000])
    assert held(taken) <= SCRATCH_BYTES, "a length is no reason to take memory"
    for at in range(begun + 1, len(data), 500_000):
        taken.receive(data[at : at + 500_000], [100_000])
        assert held(taken) <= max(SCRATCH_BYTES, 2 * (at + 500_000 - begun))
    assert taken.messages == [body] and held(taken) == 0
    taken.receive(framed(body)[:5], [100_000])
    assert held(taken) == len(body), "the next of that size is filled in place"
    taken.receive(framed(body)[5:], [100_000])
    assert taken.messages == [body, body] and held(taken) == 0


def held(taken: Taken) -> int:
    return sum(map(len, taken._filled)) + len(taken._frame or b"")


@pytest.mark.parametrize(
    "data",
    [struct.pack("<I", MAX_HEADER_BYTES + 1) + b"x", framed(b"nonsense"), b"GET / HTTP/1.1\r\n\r\n" * 10],
)
def test_hostile_headers_end_the_connection(data: bytes) -> None:
    taken = Taken(limit=100)
    taken.receive(data, [1000])
    assert taken.problem and taken.transport is None and taken.fields is None


def test_a_hostile_length_costs_nothing() -> None:
    taken = Taken(limit=100)
    taken.receive(encode_header({"a": "b"}) + b"\xff\xff\xff\xff" + b"x" * 1000, [500])
    assert taken.dropped == [0xFFFFFFFF] and taken.messages == []
    held: Any = taken._frame
    assert held is None
