"""Control messages between the two ends of a hop, as typed data and as envelopes (schemas/wire.md, "Control").

Every control message is a map with its kind under "t". Definitions travel once a process and hash: a stream's
announcement names the hash, the receiver asks with `need` if it lacks the text, the answer is `define`.
"""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from sern_core.vocabulary.errors import UsageError, WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.names import NAME_MAX_CHARS
from sern_core.vocabulary.types import ClientName, Durability, Encoding, PriorityClass, Reliability, TopicName
from sern_core.wire import framing

DEFINITION_HASH_CHARS: Final = 32
MAX_DEPTH: Final = 100_000
MAX_TIME_S: Final = 1e9
MAX_STRINGS: Final = 48
"""Items of one list in an envelope (below framing.MAX_ENVELOPE_ITEMS); longer lists are sent in parts."""
MAX_ASKED: Final = 128
"""Clients of whom a client may ask whether they are here, and of whom it waits to be told that they are."""
MAX_HASH_CHARS: Final = 128
MAX_ATTRIBUTES: Final = 16
MAX_ATTRIBUTE_CHARS: Final = 256
MAX_ATTRIBUTE_BYTES: Final = 1024
"""All attributes of a stream. With the bounds on the names every announcement fits into an envelope."""
MAX_CHANNEL_ID: Final = 0xFFFF
_ENCODINGS: Final = frozenset(Encoding)
_DIGEST: Final = re.compile(rf"(?:[0-9a-f]{{{DEFINITION_HASH_CHARS}}})?")


def definition_hash(definition: str) -> str:
    """What a definition is called on the wire: the first half of its SHA-256; empty for no definition."""
    if not definition:
        return ""
    return hashlib.sha256(definition.encode()).hexdigest()[:DEFINITION_HASH_CHARS]


@dataclass(frozen=True, slots=True)
class Announcement:
    """A stream on a channel of the session. `first`: nothing below this seq will come. `required`: who must get it.
    `more`: only `required` counts, and goes on in another part."""

    channel_id: int
    stream: StreamInfo
    definition_hash: str
    first: int
    required: tuple[str, ...] = ()
    more: bool = False


def encode_announcement(announcement: Announcement) -> framing.Envelope:
    """The envelope of an announcement. Of `required`, as many names as it has room for."""
    stream = announcement.stream
    info, spec = stream.info, stream.spec
    envelope: framing.Envelope = {
        "t": "announce",
        "ch": announcement.channel_id,
        "or": stream.id.origin,
        "boot": stream.id.boot,
        "topic": stream.id.topic,
        "type": info.type_name,
        "enc": str(info.encoding),
        "hash": info.type_hash,
        "dh": announcement.definition_hash,
        "first": announcement.first,
        "owed": list(announcement.required[:MAX_STRINGS]),
        "cls": int(spec.priority),
        "w": spec.weight,
        "rel": spec.reliable,
        "lat": spec.latched,
        "depth": spec.depth,
        "life": spec.lifespan_s,
        "dead": spec.deadline_s,
        "ret": spec.retention_s,
        "mw": spec.many_writers,
        "kept": spec.durable,
        "bg": spec.background,
        "attr": dict(stream.attributes),
        "more": announcement.more,
    }
    for word in ("kept", "bg"):  # who does not know the word need not see it
        if not envelope[word]:
            del envelope[word]
    while envelope["owed"] and framing.envelope_bytes(envelope) > framing.MAX_ENVELOPE_BYTES:
        envelope["owed"].pop()
    return envelope


def announcement_parts(announcement: Announcement) -> list[framing.Envelope]:
    """The envelopes of an announcement, so many that all of `required` has room."""
    parts: list[framing.Envelope] = []
    stream = announcement.stream
    part = replace(announcement, stream=StreamInfo(stream.id, stream.info, stream.spec), more=True)
    required = announcement.required
    while True:
        last = encode_announcement(replace(announcement, required=required))
        if len(last["owed"]) == len(required):
            return [*parts, last]
        parts.append(encode_announcement(replace(part, required=required)))  # without attributes: names fit for certain
        required = required[len(parts[-1]["owed"]) :]


def check_stream(stream: StreamInfo) -> None:
    """Raises UsageError when no peer would accept an announcement of this stream; call it where streams are made."""
    try:
        decode_announcement(encode_announcement(Announcement(1, stream, definition_hash(stream.info.definition), 1)))
    except WireError as error:
        raise UsageError(f"{stream.id.topic} cannot be announced: {error}") from error


def check_onwards(stream: StreamInfo) -> None:
    """Raises WireError unless everybody whom a relay announces this stream to takes the announcement, whatever channel
    and `first` it has there. Types are ASCII, like the names of ROS."""
    if not (stream.info.type_name.isascii() and stream.info.type_hash.isascii()):
        raise WireError(f"type {stream.info.type_name[:80]!r} or its hash holds something else than ASCII")
    onwards = Announcement(MAX_CHANNEL_ID, stream, stream.definition_hash, framing.MAX_SEQ)
    envelope = encode_announcement(onwards)
    framing.encode_envelope(envelope)  # it is not too long; what was packed is what would be unpacked
    decode_announcement(envelope)


def decode_announcement(envelope: framing.Envelope) -> Announcement:
    """Raises WireError for anything that is not a complete, sane announcement. The definition is not in it."""
    attributes = framing.take_texts(
        envelope,
        "attr",
        max_items=MAX_ATTRIBUTES,
        max_length=MAX_ATTRIBUTE_CHARS,
        max_bytes=MAX_ATTRIBUTE_BYTES,
    )
    encoding = framing.take_str(envelope, "enc", max_length=8)
    if encoding not in _ENCODINGS:
        raise WireError(f"unknown encoding {encoding!r}")
    # Whether it is a ROS name is for the routing table to say: it refuses the stream, not the connection.
    topic = TopicName(framing.take_str(envelope, "topic"))
    if not topic.startswith("/"):
        raise WireError(f"topic {topic!r} is not absolute")
    digest = framing.take_str(envelope, "dh", max_length=DEFINITION_HASH_CHARS)
    if _DIGEST.fullmatch(digest) is None:
        raise WireError(f"{digest!r} is not the hash of a definition")
    weight = framing.take_float(envelope, "w", low=1e-9, high=1e9)
    retention_s = framing.take_float(envelope, "ret", low=0.0, high=MAX_TIME_S)
    if weight is None or retention_s is None:
        raise WireError("announcement without weight or retention")
    latched = framing.take_bool(envelope, "lat")
    spec = TopicSpec(
        priority=PriorityClass(framing.take_int(envelope, "cls", high=max(PriorityClass))),
        weight=weight,
        reliability=Reliability.RELIABLE if framing.take_bool(envelope, "rel") else Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
        depth=framing.take_int(envelope, "depth", low=1, high=MAX_DEPTH),
        lifespan_s=framing.take_float(envelope, "life", low=0.0, high=MAX_TIME_S),
        deadline_s=framing.take_float(envelope, "dead", low=0.0, high=MAX_TIME_S),
        retention_s=retention_s,
        many_writers=framing.take_bool(envelope, "mw"),
        durable=framing.take_bool(envelope, "kept"),
        background=framing.take_bool(envelope, "bg"),
    )
    if spec.durable and not spec.reliable:
        raise WireError("a stream that is kept on disk is reliable")
    if spec.background and spec.priority is not PriorityClass.BULK:
        raise WireError("a stream in the background is of class bulk")
    info = TopicInfo(
        name=topic,
        type_name=framing.take_str(envelope, "type", max_length=NAME_MAX_CHARS),
        encoding=Encoding(encoding),
        type_hash=framing.take_str(envelope, "hash", max_length=MAX_HASH_CHARS),
        latched=latched,
        reliable=spec.reliable,
        depth=spec.depth,
        lifespan_s=spec.lifespan_s,
        deadline_s=spec.deadline_s,
    )
    origin = ClientName(framing.take_str(envelope, "or", max_length=64))
    return Announcement(
        channel_id=framing.take_int(envelope, "ch", low=1, high=MAX_CHANNEL_ID),
        stream=StreamInfo(StreamId(origin, framing.take_int(envelope, "boot"), topic), info, spec, attributes),
        definition_hash=digest,
        first=framing.take_int(envelope, "first", low=1, high=framing.MAX_SEQ),
        required=tuple(framing.take_strings(envelope, "owed", max_length=64)),
        more=framing.take_bool(envelope, "more"),
    )


@dataclass(frozen=True, slots=True)
class Want:
    """Whether streams are wanted. `runs`: first and last of the channels it is said of, rising. `required`: who is to
    get them if they are reliable; None: `add` and `drop` are the difference to what was said before. `more`: only
    `required` counts, and goes on in another part. On the wire its key is `owed`."""

    runs: tuple[tuple[int, int], ...]
    on: bool
    required: tuple[str, ...] | None
    add: tuple[str, ...]
    drop: tuple[str, ...]
    more: bool


def encode_want(
    channel_ids: Sequence[int],
    on: bool,
    *,
    required: Sequence[str] = (),
    add: Sequence[str] | None = None,
    drop: Sequence[str] | None = None,
    more: bool = False,
) -> framing.Envelope:
    """The envelope that says the same of rising `channel_ids`: the first, and runs of the others. A peer that knows
    neither `chs` nor differences is told each channel by itself, and whole lists."""
    runs: list[int] = []
    for channel_id in channel_ids[1:]:
        if runs and channel_id == runs[-1] + 1:
            runs[-1] = channel_id
        else:
            runs += [channel_id, channel_id]
    envelope: framing.Envelope = {
        "t": "want",
        "ch": channel_ids[0],
        "on": on,
        "chs": runs or None,
        "owed": list(required) or None,
        "add": None if add is None else list(add),
        "drop": list(drop) if drop else None,
        "more": more or None,
    }
    return {key: value for key, value in envelope.items() if value is not None}


def decode_want(envelope: framing.Envelope) -> Want:
    """Raises WireError for anything that is not a sane answer."""
    first = framing.take_int(envelope, "ch", high=0xFFFF)
    ends = envelope.get("chs", [])
    if not isinstance(ends, list) or len(ends) % 2 or not all(type(end) is int for end in ends):
        raise WireError("envelope key 'chs' must be a list of pairs of channels")
    runs = [(first, first)]
    for low, high in zip(ends[::2], ends[1::2], strict=True):
        if not runs[-1][1] < low <= high <= 0xFFFF:
            raise WireError("the channels of an answer must rise")
        runs.append((low, high))
    difference = "add" in envelope or "drop" in envelope
    return Want(
        runs=tuple(runs),
        on=framing.take_bool(envelope, "on"),
        required=None if difference else tuple(framing.take_strings(envelope, "owed", max_length=64)),
        add=tuple(framing.take_strings(envelope, "add", max_length=64)),
        drop=tuple(framing.take_strings(envelope, "drop", max_length=64)),
        more=framing.take_bool(envelope, "more"),
    )


def encode_dropped(channel_id: int, seq: int, code: int, where: str, count: int = 1) -> framing.Envelope:
    """The envelope that says that `count` messages from `seq` on were dropped; more than one only to a peer that
    understands runs. `where`: the client that will not get them, empty: several."""
    envelope: framing.Envelope = {"t": "dropped", "ch": channel_id, "seq": seq, "code": code, "to": where, "n": count}
    if count == 1:
        del envelope["n"]
    return envelope
