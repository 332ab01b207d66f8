"""Whatever a viewer sends: it is told or cut, counted, and nobody else notices."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from random import Random

import pytest

from sern_client.endpoints.foxglove import frames
from sern_client.endpoints.foxglove.frames import Fault, FrameError, Heard, Said
from sern_core.vocabulary.types import DropReason, Encoding
from sern_runtime import ros_types
from tests.exploring import seeds
from tests.support import until
from tests.viewers import Bridge, bridge, frame, head, viewer

CHAT = ros_types.topic_info("/chat", "std_msgs/msg/String", Encoding.CDR)
MEGABYTE = bytes(1_000_000)


class Raw:
    """A viewer of bytes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    async def closed_with(self) -> int:
        """Read to the end; the code of the last frame."""
        said = await self.reader.read()
        found = Said().feed(said)
        assert found and found[-1][0] == 0x88, "it is told why it is closed"
        return int.from_bytes(found[-1][2:4], "big")


@asynccontextmanager
async def raw(run: Bridge) -> AsyncIterator[Raw]:
    reader, writer = await asyncio.open_connection("127.0.0.1", run.port)
    try:
        writer.write(head())
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 101 ")
        yield Raw(reader, writer)
    finally:
        writer.transport.abort()


async def goes_on(run: Bridge) -> None:
    """Somebody else looks and gets what comes."""
    publisher = run.endpoint.advertise(CHAT)
    async with viewer(run.port) as person:
        await person.look("/chat")
        await run.looked_at("/chat")
        publisher.publish(b"text", 1)
        assert await person.got_of("/chat") == [b"text"]
    publisher.close()
    await run.looked_at("/chat", 0)


@pytest.mark.parametrize(
    ("sent", "fault", "code"),
    [
        (frame(b"", opcode=2, size=2**32), Fault.SIZE, 1009),
        (frame(b"", opcode=1, size=2**63 - 1), Fault.SIZE, 1009),
        (frame(b"", opcode=1, size=2**20 + 1), Fault.SIZE, 1009),
        (frame(b"x", opcode=2, fin=False) + frame(b"", opcode=0, size=2**24), Fault.SIZE, 1009),
        (frame(b"", opcode=3), Fault.FRAME, 1002),
        (frame(b"", opcode=11), Fault.FRAME, 1002),
        (frame(b"x" * 126, opcode=9), Fault.FRAME, 1002),
        (frame(b"", opcode=9, fin=False), Fault.FRAME, 1002),
        (frame(b"x", opcode=0), Fault.FRAME, 1002),
        (frame(b"{", fin=False) + frame(b"}"), Fault.FRAME, 1002),
        (b"\xf1\x80\0\0\0\0", Fault.FRAME, 1002),
        (b"\x81\x02{}", Fault.FRAME, 1002),
        (frame(b"\xff\xff"), Fault.FRAME, 1007),
        (b"GET / HTTP/1.1\r\n\r\n", Fault.FRAME, 1002),
    ],
    ids=["4_gib", "all", "text", "pieces", "opcode_3", "opcode_11", "long_ping", "ping_in_pieces", "no_first",
         "mixed", "reserved", "no_mask", "not_utf8", "http"],
)  # fmt: skip
async def test_what_ends_a_connection(sent: bytes, fault: Fault, code: int, caplog: pytest.LogCaptureFixture) -> None:
    async with bridge(publish=True) as run:
        async with raw(run) as bad:
            bad.writer.write(sent)
            assert await bad.closed_with() == code
        assert run.endpoint.shared.faults == {fault: 1}
        assert len([record for record in caplog.records if "is cut: " in record.getMessage()]) == 1
        await goes_on(run)


@pytest.mark.parametrize(
    "sent",
    [frame(b"no JSON"), frame(b"[]"), frame(b'{"op": 5}'), frame(b'{"op": "dance"}'), frame(b"[" * 100_000),
     frame(b"\x09rest", opcode=2), frame(b'{"a": ' * 10_000)],
    ids=["text", "list", "op_5", "dance", "deep", "opcode", "deeper"],
)  # fmt: skip
async def test_what_a_viewer_is_told_and_goes_on_with(sent: bytes, caplog: pytest.LogCaptureFixture) -> None:
    async with bridge(publish=True) as run:
        async with raw(run) as bad:
            bad.writer.write(sent)
            said = b""
            while b'"op":"status"' not in said:
                said += await bad.reader.read(65_536)
            bad.writer.write(sent)
            await until(lambda: run.endpoint.shared.faults == {Fault.CONTENT: 2})
            bad.writer.write(frame(b"", opcode=9))
            while b"\x8a\x00" not in said:
                said += await bad.reader.read(65_536)
        assert len([record for record in caplog.records if " sent " in record.getMessage()]) == 1
        await goes_on(run)


async def test_half_a_frame_and_then_nothing() -> None:
    async with bridge(publish=True) as run:
        async with raw(run) as bad:
            bad.writer.write(frame(b'{"op": "sub', size=100))
            await goes_on(run)
        await until(lambda: not run.endpoint.shared.viewers)
        assert not run.endpoint.shared.faults


@pytest.mark.parametrize(
    "said",
    [
        {"op": "subscribe"},
        {"op": "subscribe", "subscriptions": 5},
        {"op": "subscribe", "subscriptions": [5, {}, {"id": -1, "channelId": 1}, {"id": 1, "channelId": 2**40}]},
        {"op": "subscribe", "subscriptions": [{"id": "a", "channelId": True}]},
        {"op": "unsubscribe", "subscriptionIds": [5, "a", None]},
        {"op": "subscribe", "subscriptions": [{"id": n, "channelId": 9_000 + n} for n in range(2_000)]},
        {"op": "advertise", "channels": [{"id": 1}]},
    ],
    ids=range(7),
)
async def test_requests_that_make_no_sense(said: dict[str, object]) -> None:
    async with bridge(publish=True) as run:
        async with raw(run) as bad:
            bad.writer.write(frame(json.dumps(said).encode()))
            await goes_on(run)
        await until(lambda: not run.endpoint.shared.viewers)
        assert run.endpoint.looked_at == {}


async def test_a_viewer_that_never_reads_costs_its_own_messages_alone() -> None:
    async with bridge(max_waiting_bytes=4 * 2**20) as run, viewer(run.port) as other:
        publisher = run.endpoint.advertise(CHAT)
        async with raw(run) as bad:
            await until(lambda: "/chat" in other.channels)
            listed = [{"id": 1, "channelId": other.channels["/chat"]["id"]}]
            bad.writer.write(frame(json.dumps({"op": "subscribe", "subscriptions": listed}).encode()))
            await other.look("/chat")
            await run.looked_at("/chat", 2)
            sent = 0
            while run.endpoint.drops.get(DropReason.QUEUE_FULL, 0) < 20:
                publisher.publish(MEGABYTE, 1)
                sent += 1
                await other.got_of("/chat", sent)
            assert len(other.got["/chat"]) == sent
            assert run.endpoint.shared.falls_behind == 1
        await until(lambda: len(run.endpoint.shared.viewers) == 1)
        dropped = run.endpoint.drops
        assert dropped[DropReason.DISCONNECTED] <= 5, "no more than four megabytes waited, and one message"
        assert not any("left_out" in status for status in other.statuses), "it is no business of others"
        publisher.close()


async def test_a_slow_viewer_is_told_what_it_misses_and_sees_what_is_fresh() -> None:
    async with bridge(max_waiting_bytes=2 * 2**20) as run, viewer(run.port) as other:
        publisher = run.endpoint.advertise(CHAT)
        await until(lambda: "/chat" in other.channels)
        async with raw(run) as slow:
            listed = [{"id": 1, "channelId": other.channels["/chat"]["id"]}]
            slow.writer.write(frame(json.dumps({"op": "subscribe", "subscriptions": listed}).encode()))
            await run.looked_at("/chat")
            sent = 0
            while run.endpoint.drops.get(DropReason.QUEUE_FULL, 0) < 5:
                sent += 1
                publisher.publish(sent.to_bytes(4, "little") + MEGABYTE, 1)
                await asyncio.sleep(0)
            said = Said()
            found: list[bytes] = []
            while not any(b"sern/left_out/chat" in each for each in found):
                found += said.feed(await slow.reader.read(2**20))
            shown = [each for each in found if len(each) > len(MEGABYTE)]
            assert 0 < len(shown) < sent
            told = next(each for each in found if b"sern/left_out/chat" in each)
            assert b"were left out here, because this viewer takes less than what comes" in told
        publisher.close()


async def test_a_viewer_that_takes_nothing_of_what_must_arrive_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    from sern_client.endpoints.foxglove import viewer as module

    monkeypatch.setattr(module, "MUST_BYTES", 2**20)
    latched = ros_types.topic_info("/map", "nav_msgs/msg/OccupancyGrid", Encoding.CDR, latched=True)
    async with bridge() as run, viewer(run.port) as other:
        publisher = run.endpoint.advertise(latched)
        await until(lambda: "/map" in other.channels)
        async with raw(run) as bad:
            listed = [{"id": 1, "channelId": other.channels["/map"]["id"]}]
            bad.writer.write(frame(json.dumps({"op": "subscribe", "subscriptions": listed}).encode()))
            await run.looked_at("/map")
            while not run.endpoint.shared.faults[Fault.SLOW]:
                publisher.publish(MEGABYTE, 1)
                await asyncio.sleep(0)
            await until(lambda: len(run.endpoint.shared.viewers) == 1)
            await run.looked_at("/map", 0)
        publisher.close()


@pytest.mark.parametrize("seed", seeds(40))
def test_any_bytes_are_read_or_refused(seed: int) -> None:
    case = Random(seed)
    heard = Heard()
    refused: FrameError | None = None
    data = case.randbytes(case.randrange(1, 200))
    try:
        while data:
            cut = case.randrange(1, len(data) + 1)
            heard.feed(data[:cut])
            data = data[cut:]
    except FrameError as error:
        refused = error
    assert refused is None or refused.fault in (Fault.FRAME, Fault.SIZE)


@pytest.mark.parametrize("seed", seeds(20))
def test_frames_in_any_pieces_are_the_same(seed: int) -> None:
    case = Random(seed)
    said = [
        {"op": "subscribe", "subscriptions": [{"id": n, "channelId": n}], "x": "y" * case.randrange(0, 70_000)}
        for n in range(3)
    ]
    wire = b""
    for each in said:
        text = json.dumps(each).encode()
        middle = case.randrange(0, len(text) + 1)
        mask = case.randbytes(4)
        for part, opcode, fin in ((text[:middle], 1, False), (text[middle:], 0, True)):
            plain = frame(bytes(byte ^ mask[at % 4] for at, byte in enumerate(part)), opcode=opcode, fin=fin)
            wire += plain[: len(plain) - len(part) - 4] + mask + plain[len(plain) - len(part) :]
            wire += frame(b"ping", opcode=9) if case.random() < 0.3 else b""
    heard, found = Heard(), []
    while wire:
        cut = case.randrange(1, len(wire) + 1)
        found += heard.feed(wire[:cut])
        wire = wire[cut:]
    assert [each.said for each in found] == said


@pytest.mark.parametrize("seed", seeds(20))
def test_what_the_server_says_in_any_pieces(seed: int) -> None:
    case = Random(seed)
    bodies = [case.randbytes(case.choice((0, 100, 200, 70_000))) for _ in range(4)]
    wanted = [frames.message_head(number, 5, len(body)) + body for number, body in enumerate(bodies)]
    wanted.append(frames.text_frame({"op": "status"}))
    wire, said, found = b"".join(wanted), Said(), []
    while wire:
        cut = case.randrange(1, len(wire) + 1)
        found += said.feed(wire[:cut])
        wire = wire[cut:]
    assert found == wanted
