"""`schemas/wire.md` says what the code does: its tables are read and compared."""

import ast
import json
import re
import struct
from pathlib import Path

import pytest

from sern_core.vocabulary.codec_names import Codec
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import DROP_CODES, ClientName, Encoding, TopicName
from sern_core.wire import announce, framing
from sern_runtime import feed
from tests.make_vectors import DIRECTORY
from tests.world import World

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = (ROOT / "schemas" / "wire.md").read_text()
CORE = [
    ROOT / "sern_core" / name
    for name in (
        "wire/announce.py",
        "link/answers.py",
        "site/client.py", "site/subscription.py", "site/object_mirror.py",
        "link/streams_in.py",
        "link/streams_out.py",
        "relay/hub.py", "relay/hub_link_handler.py", "relay/moves.py", "relay/peers.py",
        "relay/hub_port.py", "relay/hub_subscriptions.py",
        "relay/claims.py", "relay/peer_control.py", "relay/peer_rules.py", "relay/revocations.py",
        "relay/object_exchange.py", "relay/peer_objects.py", "relay/feed_owners.py",
        "relay/relayed_streams.py",
        "link/session.py",
        "link/control_reader.py",
        "relay/presence.py",
        "link/handshake.py",
    )
]  # fmt: skip


def section(title: str) -> str:
    """The text under a heading, up to the next one of its level or above."""
    found = re.search(rf"^(#+) {re.escape(title)}\n", DOCUMENT, re.MULTILINE)
    assert found is not None, f"no section {title!r}"
    rest = DOCUMENT[found.end() :]
    end = re.search(rf"^#{{1,{len(found[1])}}} ", rest, re.MULTILINE)
    return rest[: end.start()] if end else rest


def table(text: str) -> dict[str, list[str]]:
    """First column (without backticks) to the others, of every table in `text`; headings and rules are left out."""
    rows: dict[str, list[str]] = {}
    lines = text.splitlines()
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("|") and not line.startswith("|---") and not following.startswith("|---"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            rows[cells[0].strip("`")] = cells[1:]
    return rows


CONTROL_KINDS = re.findall(r"^### (.+)$", section("Control"), re.MULTILINE)


def _sent() -> dict[str, set[str]]:
    """Control kind to the keys of every dict that the core builds for it."""
    kinds: dict[str, set[str]] = {}
    for path in CORE:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Dict):
                continue
            pairs = {
                key.value: value
                for key, value in zip(node.keys, node.values, strict=True)
                if isinstance(key, ast.Constant) and isinstance(key.value, str)
            }
            kind = pairs.get("t")
            if isinstance(kind, ast.Constant) and isinstance(kind.value, str):
                kinds.setdefault(kind.value, set()).update(pairs)
    return kinds


def _understood() -> set[str]:
    """Control kinds that the core compares `kind` with."""
    found: set[str] = set()
    for path in CORE:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Compare) and isinstance(node.left, ast.Name) and node.left.id == "kind":
                for part in ast.walk(node):
                    if isinstance(part, ast.Constant) and isinstance(part.value, str):
                        found.add(part.value)
    return found


def test_control_messages_are_those_of_the_code() -> None:
    sent = _sent()
    assert set(CONTROL_KINDS) == set(sent) == _understood()
    for kind in CONTROL_KINDS:
        assert set(table(section(kind))) == sent[kind], kind
        assert table(section(kind))["t"] == ["str 16", f"`{kind}`"]


def test_control_vectors_have_the_documented_keys() -> None:
    seen = set()
    for path in DIRECTORY.glob("*.json"):
        vector = json.loads(path.read_text())
        if isinstance(vector, dict) and vector["layer"] == "control":
            kind = vector["envelope"]["t"]
            seen.add(kind)
            rows = table(section(kind))
            required = {key for key, cells in rows.items() if "optional" not in cells[0]}
            assert required <= set(vector["envelope"]) <= set(rows), path.name
    assert seen == set(CONTROL_KINDS)


def _type_of(cell: str) -> tuple[str, float, float] | None:
    """(kind, low, high) of a type cell, for the kinds whose bounds can be tried."""
    text = cell.removesuffix(", optional").removesuffix(", or nil")
    if match := re.fullmatch(r"str (\d+)", text):
        return "str", 0, int(match[1])
    if match := re.fullmatch(r"(int|float)(?:, (\S+) to (\S+))?", text):
        low, high = (match[2] or "0", match[3] or "2^63-1")
        if high == "2^63-1":
            return match[1], float(low), 2**63 - 1
        base, _, power = high.partition("^")
        return match[1], float(low), float(base) ** float(power or 1)
    return None


def test_announce_bounds_are_those_of_the_decoder() -> None:
    identity = StreamId(ClientName("robot"), 7, TopicName("/robot/odom"))
    stream = StreamInfo(identity, TopicInfo(identity.topic, "a/b", Encoding.CDR), TopicSpec())
    good = announce.encode_announcement(announce.Announcement(1, stream, "", 1))
    tried = 0
    for key, cells in table(section("announce")).items():
        bounds = _type_of(cells[0])
        if bounds is None or key in ("t", "enc", "dh"):
            continue
        kind, low, high = bounds
        start = "/" if key == "topic" else ""
        convert = int if kind == "int" else float
        fits: object = start + "x" * (int(high) - len(start)) if kind == "str" else convert(high)
        beyond: object = start + "x" * (int(high) + 1 - len(start)) if kind == "str" else convert(high) * 2
        below: object = 1 if kind == "str" else convert(low) - 1
        announce.decode_announcement(good | {key: fits})
        for bad in (beyond, below):
            with pytest.raises(WireError):
                announce.decode_announcement(good | {key: bad})
        if "optional" in cells[0]:
            announce.decode_announcement({name: value for name, value in good.items() if name != key})
        tried += 1
    assert tried > 10
    cell = table(section("announce"))["attr"]
    assert str(announce.MAX_ATTRIBUTES) in cell[1] and str(announce.MAX_ATTRIBUTE_BYTES) in cell[1]
    assert f"str {announce.MAX_ATTRIBUTE_CHARS} to str {announce.MAX_ATTRIBUTE_CHARS}" in cell[0]
    assert str(announce.MAX_STRINGS) in table(section("announce"))["owed"][1]


def test_limits() -> None:
    rows = table(section("Limits"))
    assert {name: int(cells[0]) for name, cells in rows.items()} == {name: getattr(framing, name) for name in rows}
    bounds = {name for name in vars(framing) if re.fullmatch(r"MAX_(?!AGE_S)[A-Z_]+", name)}
    assert bounds <= set(rows), "a limit is missing in the table"


def test_kinds_flags_and_drop_codes() -> None:
    kinds = {name: cells for name, cells in table(section("Datagrams")).items() if name.isupper() and len(cells) == 3}
    assert {name: int(cells[0]) for name, cells in kinds.items()} == {kind.name: kind.value for kind in framing.Kind}
    flags = {name: int(cells[0], 16) for name, cells in table(section("Frames")).items() if name.startswith("FLAG_")}
    assert flags == {name: value for name, value in vars(framing).items() if name.startswith("FLAG_")}
    assert sum(flags.values()) == framing.KNOWN_FLAGS
    codecs = {name: int(cells[0]) for name, cells in table(section("Encoded bodies")).items()}
    assert codecs == {codec.name: codec.value for codec in Codec}
    codes = {cells[0].strip("`"): int(code) for code, cells in table(section("Drop codes")).items()}
    assert codes == {reason.value: code for reason, code in DROP_CODES.items()}


def test_layouts() -> None:
    frames = table(section("Frames"))
    frame_types = {"DATA": framing.FRAME_DATA, "ACK": framing.FRAME_ACK, "WATERMARK": framing.FRAME_WATERMARK}
    assert int(frames["PING"][0]) == framing.FRAME_PING
    for name in ("DATA", "DATA` at offset 0", "ACK", "WATERMARK"):
        number, layout, text, size = frames[name][:4]
        packer = getattr(framing, layout.strip("`"))
        assert int(number) == frame_types[name.split("`")[0]]
        assert packer.format == text.strip("`")
        assert packer.size == struct.calcsize(packer.format) == int(size.split(",")[0])
    for name, packer in (("HEADER", framing.HEADER), ("FEED_HEADER", feed.HEADER)):
        (rows,) = [cells for title in ("Datagrams", "The plain feed") if (cells := table(section(title)).get(name))]
        assert rows == [f"`{packer.format}`", str(packer.size)]
    assert f"version u8 ({feed.VERSION})" in section("The plain feed")


def test_age_error_formula() -> None:
    for code in range(1, 255):
        assert framing.AGE_ERRORS_S[code] == pytest.approx(100e-6 * 2 ** ((code - 1) / 8))
    assert (framing.AGE_ERRORS_S[0], framing.AGE_ERRORS_S[255]) == (0.0, float("inf"))
    assert "100 µs · 2^((n - 1) / 8)" in section("Time")


def test_handshakes_have_the_documented_keys() -> None:
    """What two cores say to each other, datagram by datagram."""
    world = World()
    robot = world.client("robot")
    port = world.relay.port(robot.name)
    said: dict[str, set[str]] = {}

    def note(data: bytes | None) -> bytes:
        assert data is not None
        said[framing.Kind(framing.decode_header(data).kind).name] = set(framing.decode_handshake(data))
        return data

    link = robot.core.link
    link.connected(now=0.0)
    hello = note(link.next_datagram(now=0.0))
    port.receive(framing.encode_header(framing.Kind.DATA, 9, 1, 0), now=0.0)
    note(port.next_datagram(now=0.0))
    port.receive(framing.encode_handshake(framing.Kind.HELLO, 1, 0, {"name": "mallory"}), now=0.0)
    note(port.next_datagram(now=0.0))
    port.receive(hello, now=0.0)
    link.receive(note(port.next_datagram(now=0.0)), now=0.0)
    note(link.handshake.join(0.0))
    link.close("done", now=0.0, moved=True)
    note(link.next_datagram(now=0.0))
    link.connected(now=1.0)
    note(link.next_datagram(now=1.0))
    assert set(said) == {kind.name for kind in framing.Kind if kind is not framing.Kind.DATA}
    for kind, keys in said.items():
        assert keys == set(table(section(kind))), kind
        with_all = {"HELLO": "hello-last", "CLOSE": "close-moved"}.get(kind, kind.lower())
        path = DIRECTORY / f"{with_all}.json"
        assert keys == set(json.loads(path.read_text())["envelope"]), kind
