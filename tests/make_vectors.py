"""The golden vectors of the wire format: what they mean, how they are encoded, and what must be rejected.

`python -m tests.make_vectors` writes `schemas/vectors/*.json`; `tests/test_vectors.py` checks the files against the
codec in both directions. A change of a file is a change of the protocol: see "Compatibility" in `schemas/wire.md`.
"""

import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from sern_core.objects.changes import Begin, Define, Delete, End, Put, set_of
from sern_core.objects.changes import encode as encode_change
from sern_core.vocabulary.errors import RemoteError
from sern_core.vocabulary.types import (
    DROP_CODES,
    DropReason,
    ObjectKind,
)
from sern_core.wire import framing
from sern_core.wire.announce import definition_hash
from tests.control_vectors import DEFINITION, control_messages

DIRECTORY: Final = Path(__file__).resolve().parents[1] / "schemas" / "vectors"

Vector = dict[str, Any]

FLAGS: Final = {"TOMBSTONE": framing.FLAG_DROP_MARKER, "REPLAY": framing.FLAG_REPLAY, "URGENT": framing.FLAG_URGENT}
"""The vectors have names of their own for flags, which never change."""
"""Of the examples of ZeroMQ's RFC 26 and libzmq's manual, which are nobody's."""


# --- meaning to bytes and back ----------------------------------------------------------------------------------------


def encode_frame(frame: Vector) -> bytes:
    match frame["type"]:
        case "DATA":
            flags = sum(FLAGS[name] for name in frame["flags"])
            body = bytes.fromhex(frame["body"])
            if frame["offset"]:
                head = framing.encode_data_next(
                    flags, frame["channel"], frame["seq"], frame["offset"], frame["total"], len(body)
                )
            else:
                head = framing.encode_data_first(
                    flags,
                    frame["channel"],
                    frame["seq"],
                    frame["total"],
                    len(body),
                    frame["stamp_ns"],
                    (frame["age_100us"] + 0.5) * framing.AGE_UNIT_S,
                    frame["codec"],
                    framing.AGE_ERRORS_S[frame["age_error"]],
                )
            return head + body
        case "ACK":
            return framing.encode_ack(
                frame["lane"],
                frame["highest"],
                frame["sack"],
                frame["echo_us"],
                frame["received_us"],
                frame["cumulative_bytes"],
            )
        case "WATERMARK":
            return framing.encode_watermark(frame["channel"], frame["delivered"])
        case _:
            return framing.PING_FRAME


def encode(vector: Vector) -> bytes:
    """The bytes that a vector's meaning stands for."""
    if vector["layer"] == "control":
        return framing.encode_control(vector["envelope"], vector["attachment"].encode())
    header = vector["header"]
    kind = framing.Kind[header["kind"]]
    if kind is not framing.Kind.DATA:
        return framing.encode_handshake(kind, header["tag"], header["stamp_us"], vector["envelope"])
    head = framing.encode_header(kind, header["tag"], header["number"], header["stamp_us"], version=header["version"])
    return b"".join((head, *map(encode_frame, vector["frames"])))


class Frames:
    """A FrameSink that writes down what it is told."""

    def __init__(self) -> None:
        self.frames: list[Vector] = []

    def on_data(
        self,
        flags: int,
        channel_id: int,
        seq: int,
        offset: int,
        total: int,
        body: framing.Datagram,
        stamp_ns: int,
        age_s: float,
        codec: int,
        error_s: float,
    ) -> None:
        frame: Vector = {
            "type": "DATA",
            "flags": [name for name, bit in FLAGS.items() if flags & bit],
            "channel": channel_id,
            "seq": seq,
            "offset": offset,
            "total": total,
            "body": body.hex(),
        }
        if offset == 0:
            age = round(age_s / framing.AGE_UNIT_S)
            frame |= {
                "stamp_ns": stamp_ns,
                "age_100us": age,
                "codec": codec,
                "age_error": framing.AGE_ERRORS_S.index(error_s),
            }
        self.frames.append(frame)

    def on_ack(self, lane: int, highest: int, sack: int, echo_us: int, received_us: int, cum_bytes: int) -> None:
        self.frames.append(
            {
                "type": "ACK",
                "lane": lane,
                "highest": highest,
                "sack": sack,
                "echo_us": echo_us,
                "received_us": received_us,
                "cumulative_bytes": cum_bytes,
            }
        )

    def on_watermark(self, channel_id: int, delivered: int) -> None:
        self.frames.append({"type": "WATERMARK", "channel": channel_id, "delivered": delivered})

    def on_ping(self) -> None:
        self.frames.append({"type": "PING"})


def decode(layer: str, data: bytes) -> Vector:
    """The meaning of bytes, without name and text. Raises what the codec raises."""
    if layer == "control":
        envelope, attachment = framing.decode_control(data)
        return {"layer": layer, "envelope": envelope, "attachment": attachment.decode()}
    header = framing.decode_header(data)
    head = {
        "version": header.version,
        "kind": framing.Kind(header.kind).name,
        "tag": header.tag,
        "number": header.number,
        "stamp_us": header.stamp_us,
    }
    if header.kind != framing.Kind.DATA:
        return {"layer": layer, "header": head, "envelope": framing.decode_handshake(data)}
    sink = Frames()
    framing.decode_frames(data, sink)
    return {"layer": layer, "header": head, "frames": sink.frames}


# --- what is valid ----------------------------------------------------------------------------------------------------


def _handshake(name: str, what: str, kind: str, envelope: Vector, *, tag: int = 7) -> Vector:
    header = {"version": framing.HANDSHAKE_VERSION, "kind": kind, "tag": tag, "number": 0, "stamp_us": 1_500_000}
    return {"name": name, "what": what, "layer": "datagram", "header": header, "envelope": envelope}


def _data(name: str, what: str, *frames: Vector, number: int = 1) -> Vector:
    header = {"version": 1, "kind": "DATA", "tag": 7, "number": number, "stamp_us": 1_500_000}
    return {"name": name, "what": what, "layer": "datagram", "header": header, "frames": list(frames)}


def _frame(*flags: str, body: bytes, total: int | None = None, offset: int = 0, **more: int) -> Vector:
    frame: Vector = {
        "type": "DATA",
        "flags": list(flags),
        "channel": 3,
        "seq": 41,
        "offset": offset,
        "total": len(body) if total is None else total,
        "body": body.hex(),
    }
    if offset == 0:
        frame |= {"stamp_ns": 1_700_000_000_123_456_789, "age_100us": 250, "codec": 0, "age_error": 0}
    return frame | more


def _object(value: bytes | None, *, upto: int | None) -> Put:
    return Put(
        object_id="zones/hall",
        owner="site1",
        kind=ObjectKind.OBSTACLE,
        type_name="shape_msgs/msg/SolidPrimitive",
        definition_hash="RIHS01_" + "0f" * 32,
        text_hash=definition_hash(DEFINITION),
        attributes={"colour": "red"},
        value=value,
        value_bytes=100_000 if value is None else len(value),
        value_sha256="ab" * 32 if value is None else "",
        seq=3,
        ros_stamp_ns=-1,
        wall_ns=1_700_000_000_123_456_789,
        upto=upto,
    )


def valid() -> list[Vector]:
    """One vector or more for each kind of datagram, frame and control message."""
    ack: Vector = {
        "type": "ACK",
        "lane": 0,
        "highest": 1000,
        "sack": 0x8000_0000_0000_0005,
        "echo_us": 1_400_000,
        "received_us": 77_000_000,
        "cumulative_bytes": 1_234_567,
    }
    watermark = {"type": "WATERMARK", "channel": 65_535, "delivered": 0xFFFF_FFFF}
    ping = {"type": "PING"}
    vectors = [
        _handshake(
            "hello", "the first words of a client", "HELLO", {"name": "jackal1", "boot": 5, "vmin": 1, "vmax": 1}
        ),
        _handshake(
            "welcome",
            "the session exists; `echo` is the stamp of the HELLO",
            "WELCOME",
            {"name": "relay", "boot": 2**63 - 1, "version": 1, "echo": 1_400_000, "at": 1_500_000, "again": False},
        ),
        _handshake("refuse", "no session", "REFUSE", {"code": "version", "why": "no wire version in common"}),
        _handshake("reset", "say hello again", "RESET", {}, tag=255),
        _handshake(
            "join",
            "this connection, too, belongs to the session with that tag",
            "JOIN",
            {"name": "jackal1", "boot": 5, "relay": 2**63 - 1},
        ),
        _handshake("close", "the session ends on purpose", "CLOSE", {"why": "shutting down"}, tag=1),
        _handshake(
            "hello-last",
            "of a client that had a session with another relay process",
            "HELLO",
            {"name": "jackal1", "boot": 5, "vmin": 1, "vmax": 1, "last": 2**63 - 1},
        ),
        _handshake("close-moved", "it goes on elsewhere", "CLOSE", {"why": "moves", "moved": True}, tag=1),
        _data("data-whole", "one message in one fragment", _frame(body=b"hello")),
        _data("data-empty", "a message of no bytes", _frame(body=b"")),
        _data("data-first", "the first fragment of 10 bytes", _frame(body=b"01234", total=10)),
        _data("data-next", "the second fragment of it", _frame(body=b"56789", total=10, offset=5), number=2),
        _data(
            "data-urgent",
            "class control; negative stamp, greatest age, seq and channel, unknown age error",
            _frame(
                "URGENT",
                body=b"\x00",
                channel=65_535,
                seq=0xFFFF_FFFF,
                stamp_ns=-1,
                age_100us=0xFFFF_FFFF,
                age_error=255,
            ),
        ),
        _data("data-age-error", "its age may be 3.2 ms too young", _frame(body=b"pose", age_error=41)),
        _data("data-replay", "a latched sample for a late joiner", _frame("REPLAY", body=b"map")),
        _data(
            "data-lz4",
            "120 bytes, `robot ` twenty times, as an LZ4 block",
            _frame(body=bytes.fromhex("000000786f726f626f742006005a506f626f7420"), codec=1),
        ),
        _data(
            "data-zstd",
            "the same as a Zstandard frame",
            _frame(body=bytes.fromhex("0000007828b52ffd20786d000030726f626f742001002f692902"), codec=2),
        ),
        _data(
            "data-tombstone",
            "stands for a message whose lifespan was over",
            _frame("TOMBSTONE", body=bytes([DROP_CODES[DropReason.LIFESPAN]])),
        ),
        _data("ack", "an acknowledgement alone is not numbered", ack, number=0),
        _data("watermark", "all of channel 65535 up to 2^32-1 had its turn", watermark),
        _data("ping", "asks for an acknowledgement", ping),
        _data(
            "several-frames",
            "an acknowledgement, a watermark and two messages in one datagram",
            ack,
            watermark,
            _frame(body=b"a", seq=1),
            _frame(body=b"b", seq=2),
        ),
        _data("no-frames", "nothing but a header is a valid datagram", number=0),
        *control_messages(),
        *(
            _data(f"object-{name}", what, _frame(body=encode_change(change)))
            for name, what, change in (
                ("begin", "all objects are told anew", Begin(77, whole=True)),
                ("define", "the text of a definition", Define(definition_hash(DEFINITION), DEFINITION)),
                ("put", "an object with its value", _object(b"value", upto=None)),
                ("put-large", "an object whose value is too large", _object(None, upto=12)),
                ("set", "another value of an object", set_of(_object(b"other", upto=12))),
                ("delete", "it is gone", Delete("zones/hall", 13)),
                ("end", "all is told up to a version", End(14)),
            )
        ),
    ]
    for vector in vectors:
        vector["hex"] = encode(vector).hex()
    return vectors


# --- what is not ------------------------------------------------------------------------------------------------------


def _bad_bytes() -> Iterator[tuple[str, str, bytes]]:
    """(name, layer, bytes) of what must be rejected."""
    by_name = {vector["name"]: bytes.fromhex(vector["hex"]) for vector in valid()}
    header = by_name["no-frames"]
    whole = by_name["data-whole"]
    first = len(header)

    def changed(data: bytes, at: int, value: int, size: int = 1) -> bytes:
        return data[:at] + value.to_bytes(size) + data[at + size :]

    for length in range(framing.HEADER_BYTES):
        yield f"header-of-{length}", "datagram", header[:length]
    yield "oversize-datagram", "datagram", b""  # filled in by `rejected`: too long to print
    yield "bad-magic", "datagram", changed(header, 0, 0x54)
    yield "version-0", "datagram", changed(header, 1, 0)
    yield "version-2", "datagram", changed(header, 1, 2)
    yield "handshake-version-2", "datagram", changed(by_name["hello"], 1, 2)
    yield "kind-0", "datagram", changed(header, 2, 0)
    yield "kind-7", "datagram", changed(header, 2, 7)
    yield "kind-17", "datagram", changed(header, 2, 17)
    yield "frame-type-0", "datagram", header + b"\x00"
    yield "frame-type-5", "datagram", header + b"\x05"
    yield "frame-after-a-good-one", "datagram", whole + b"\xff"
    for name in ("data-first", "data-next", "ack", "watermark"):
        data = by_name[name]
        for length in range(first + 1, len(data)):
            yield f"{name}-cut-to-{length - first}", "datagram", data[:length]
    for name in ("hello", "reset"):
        yield f"{name}-without-envelope", "datagram", by_name[name][:first]
    yield "hello-cut", "datagram", by_name["hello"][:-1]
    yield "hello-with-more", "datagram", by_name["hello"] + b"\x00"
    yield "flag-8", "datagram", changed(whole, first + 1, 0x08)
    yield "flag-128", "datagram", changed(whole, first + 1, 0x80)
    yield "fragment-outside", "datagram", changed(whole, first + 12, 4, 4)
    yield "fragment-outside-at-offset", "datagram", changed(by_name["data-next"], first + 8, 6, 4)
    yield "fragment-wraps", "datagram", changed(by_name["data-next"], first + 8, 0xFFFF_FFFF, 4)
    yield "empty-fragment", "datagram", header + framing.encode_data_next(0, 3, 41, 5, 10, 0)
    yield "empty-first-fragment", "datagram", header + framing.encode_data_first(0, 3, 41, 10, 0, 0, 0.0, 0)
    size = framing.MAX_FRAGMENT_BYTES + 1
    yield "oversize-fragment", "datagram", header + framing.encode_data_first(0, 3, 41, size, size, 0, 0.0, 0)
    marker = framing.FLAG_DROP_MARKER
    yield (
        "tombstone-of-two",
        "datagram",
        header + framing.encode_data_first(marker, 3, 41, 2, 2, 0, 0.0, 0) + b"\1\1",
    )
    yield "tombstone-of-none", "datagram", header + framing.encode_data_first(marker, 3, 41, 0, 0, 0, 0.0, 0)
    yield "tombstone-empty-of-one", "datagram", header + framing.encode_data_first(marker, 3, 41, 1, 0, 0, 0.0, 0)
    yield "five-acks", "datagram", header + 5 * by_name["ack"][first:]

    def envelope(data: bytes) -> bytes:
        return struct.pack("!H", len(data)) + data

    def nested(depth: int, opening: bytes) -> bytes:
        return b"\x81\xa1a" + opening * depth + b"\xc0"

    bad_envelopes = {
        "none": b"",
        "nil": b"\xc0",
        "array": b"\x90",
        "text": b"\xa1t",
        "two-maps": b"\x80\x80",
        "unused-code": b"\x81\xa1a\xc1",
        "not-utf8": b"\x81\xa1a\xa1\xff",
        "key-not-utf8": b"\x81\xa1\xff\xc0",
        "integer-key": b"\x81\x01\xc0",
        "nil-key": b"\x81\xc0\xc0",
        "repeated-key": b"\x82\xa1a\x01\xa1a\x02",
        "binary": b"\x81\xa1a\xc4\x01\x00",
        "extension": b"\x81\xa1a\xd4\x05\x00",
        "empty-extension": b"\x81\xa1a\xc7\x00\x05",
        "timestamp": b"\x81\xa1a\xd6\xff\x00\x00\x00\x00",
        "65-items-in-an-array": b"\x81\xa1a\xdc\x00\x41" + b"\xc0" * 65,
        "65-items-in-a-map": b"\xde\x00\x41" + b"".join(b"\xa1" + bytes([32 + i]) + b"\xc0" for i in range(65)),
        "array-of-4-billion": b"\x81\xa1a\xdd\xff\xff\xff\xff",
        "map-of-4-billion": b"\xdf\xff\xff\xff\xff",
        "text-of-4-billion": b"\x81\xa1a\xdb\xff\xff\xff\xff",
        "arrays-3-deep": nested(3, b"\x91"),
        "arrays-4000-deep": nested(4000, b"\x91"),
        "maps-3-deep": nested(3, b"\x81\xa1a"),
        "maps-1000-deep": nested(1000, b"\x81\xa1a"),
        "4097-bytes": b"\x81\xa1a\xda\x0f\xfb" + b"x" * 4091,
        "maps-to-the-end": b"\xdf\x00\x00\x10\x00" + b"\xa1a\x80" * 1363,
    }
    for name, data in bad_envelopes.items():
        yield f"envelope-{name}", "control", envelope(data)
    synced = by_name["synced"]
    for length in range(len(synced)):
        yield f"control-cut-to-{length}", "control", synced[:length]
    packed = zlib.compress(b"x" * 100, 9)
    yield "zlib-cut", "control", synced + packed[:-1]
    yield "zlib-head-only", "control", synced + packed[:2]
    yield "zlib-followed", "control", synced + packed + b"\x00"
    yield "zlib-garbage", "control", synced + b"\x00garbage"
    yield "zlib-wrong-checksum", "control", synced + packed[:-1] + bytes([packed[-1] ^ 1])
    yield "zlib-dictionary", "control", synced + b"\x78\xf9\x00\x00\x00\x01"
    yield "zlib-bomb", "control", synced + zlib.compress(bytes(framing.MAX_ATTACHMENT_BYTES + 1), 9)


def rejected() -> list[Vector]:
    """What a receiver must not accept, with the text of the error it raises."""
    vectors = []
    for name, layer, data in _bad_bytes():
        if name == "oversize-datagram":
            data = bytes(framing.MAX_DATAGRAM_BYTES + 1)
            shown: Vector = {"zero_bytes": len(data)}
        else:
            shown = {"hex": data.hex()}
        try:
            decode(layer, data)
        except RemoteError as error:
            vectors.append({"name": name, "layer": layer, **shown, "error": type(error).__name__, "text": str(error)})
        else:
            raise AssertionError(f"{name} was accepted")
    return vectors


def files() -> dict[str, str]:
    """File name to content, as it must be on disk."""
    written = {f"{vector['name']}.json": json.dumps(vector, indent=2) + "\n" for vector in valid()}
    lines = ",\n".join(json.dumps(vector) for vector in rejected())
    written["rejected.json"] = f"[\n{lines}\n]\n"
    return written


def main() -> None:
    DIRECTORY.mkdir(parents=True, exist_ok=True)
    wanted = files()
    for path in DIRECTORY.glob("*.json"):
        if path.name not in wanted:
            path.unlink()
    for name, text in wanted.items():
        (DIRECTORY / name).write_text(text)


if __name__ == "__main__":
    main()
