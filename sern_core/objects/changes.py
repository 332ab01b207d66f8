"""Changes of objects as messages of an object stream (schemas/wire.md, "Objects"): bytes and back.

A batch is `begin` (the first alone, and where all is told anew), then `define`, `put` and `delete` in any number,
and at its end a version: on the last change, or in an `end` of its own. A reader that has a batch whole asks for
what is newer than that version.
"""

from typing import Final, NamedTuple

from sern_core.objects.xr_object import XrObject
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import UsageError, WireError
from sern_core.vocabulary.message import StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, ObjectKind, PriorityClass, Reliability, TopicName
from sern_core.wire import framing
from sern_core.wire.announce import DEFINITION_HASH_CHARS, definition_hash

OBJECTS_TOPIC: Final = TopicName("/_sern/objects")
"""The stream of an end's objects; it is the two ends' own business, and no topic of anybody."""
MAX_HASH_CHARS: Final = 128
MAX_WANTS: Final = 24
"""Kinds and patterns of one subscription, which is one envelope."""
MAX_TEXT_BYTES: Final = 256 * 2**10
"""The largest text of a definition, and so the largest attachment."""


class Begin(NamedTuple):
    """`whole`: what is not put again before the batch ends is gone. `epoch`: of the registry that tells."""

    epoch: int
    whole: bool


class Define(NamedTuple):
    """The text of a definition, which later puts name by its hash."""

    text_hash: str
    text: str


class Put(NamedTuple):
    """An object as it is now. `value` None with `value_bytes` above 0: it is too large to be told; -1: it has none."""

    object_id: str
    owner: str
    kind: ObjectKind
    type_name: str
    definition_hash: str
    text_hash: str
    attributes: dict[str, str]
    value: bytes | None
    value_bytes: int
    value_sha256: str
    seq: int
    ros_stamp_ns: int | None
    wall_ns: int
    upto: int | None = None


class Set(NamedTuple):
    """An object that the reader has from the same feed, with another value: the rest of it is as it was."""

    object_id: str
    value: bytes | None
    value_bytes: int
    value_sha256: str
    seq: int
    ros_stamp_ns: int | None
    wall_ns: int
    upto: int | None = None


class Delete(NamedTuple):
    object_id: str
    upto: int | None = None


class End(NamedTuple):
    """The batch is over, and with it everything up to this version told."""

    upto: int


Change = Begin | Define | Put | Set | Delete | End


def object_stream(origin: ClientName, boot: int) -> StreamInfo:
    """The stream of an end's objects: it waits behind class control, and nothing of it is lost."""
    spec = TopicSpec(
        priority=PriorityClass.STATE,
        reliability=Reliability.RELIABLE,
        lifespan_s=None,
        retention_s=1e9,
        compression=Compression.NONE,
    )
    return StreamInfo(StreamId(origin, boot, OBJECTS_TOPIC), TopicInfo(OBJECTS_TOPIC, "", Encoding.RAW), spec)


def text_hash(text: str) -> str:
    """What the text of a definition is called on the wire; empty for none."""
    return definition_hash(text)


def put_of(item: XrObject, text: str, *, upto: int | None = None) -> Put:
    """An object as it is told; `text` is its definition."""
    return Put(
        item.id,
        item.owner,
        item.kind,
        item.type_name,
        item.definition_hash,
        text_hash(text),
        dict(item.attributes),
        item.value,
        item.value_bytes,
        item.value_sha256 or "",
        item.seq,
        item.ros_stamp_ns,
        item.wall_ns,
        upto,
    )


def set_of(put: Put) -> Set:
    """What is new of it, to a reader that has the rest."""
    return Set(
        put.object_id,
        put.value,
        put.value_bytes,
        put.value_sha256,
        put.seq,
        put.ros_stamp_ns,
        put.wall_ns,
        put.upto,
    )


def encode(change: Change) -> bytes:
    """Raises UsageError for an object whose texts do not fit into one envelope."""
    envelope: framing.Envelope
    attachment = b""
    if isinstance(change, Begin):
        envelope = {"op": "begin", "epoch": change.epoch, "all": change.whole}
    elif isinstance(change, End):
        envelope = {"op": "end", "upto": change.upto}
    elif isinstance(change, Define):
        envelope, attachment = {"op": "define", "dh": change.text_hash}, change.text.encode()
    elif isinstance(change, Delete):
        envelope = {"op": "delete", "id": change.object_id}
    else:
        attachment = change.value or b""
        envelope = {"op": "set", "id": change.object_id}
        if isinstance(change, Put):
            envelope["op"] = "put"
            texts = (change.kind, change.owner, change.type_name, change.definition_hash, change.text_hash)
            for key, text in zip(("kind", "owner", "type", "hash", "dh"), texts, strict=True):
                if text:
                    envelope[key] = str(text)
            if change.attributes:
                envelope["attr"] = change.attributes
        envelope |= {"n": change.value_bytes, "seq": change.seq, "wall": change.wall_ns}
        if change.value is None and change.value_sha256:
            envelope["sha"] = change.value_sha256
        if change.value is not None:
            envelope["val"] = True
        if change.ros_stamp_ns is not None:
            envelope["stamp"] = change.ros_stamp_ns
    if isinstance(change, (Put, Set, Delete)) and change.upto is not None:
        envelope["upto"] = change.upto
    if framing.envelope_bytes(envelope) > framing.MAX_ENVELOPE_BYTES:
        raise UsageError(
            f"object {str(envelope.get('id'))[:80]}: id, type and attributes are more than "
            f"{framing.MAX_ENVELOPE_BYTES} bytes; put less into its attributes"
        )
    return framing.encode_control(envelope, attachment)


def decode(body: bytes) -> Change:
    """Raises WireError for what no honest peer sends."""
    envelope, attachment = framing.decode_control(body, max_bytes=MAX_TEXT_BYTES)
    operation = framing.take_str(envelope, "op", max_length=8)
    if operation == "begin":
        return Begin(framing.take_int(envelope, "epoch"), framing.take_bool(envelope, "all"))
    if operation == "end":
        return End(framing.take_int(envelope, "upto"))
    if operation == "define":
        try:
            text = attachment.decode()
        except UnicodeDecodeError as error:
            raise WireError("the text of a definition is not UTF-8") from error
        named = framing.take_str(envelope, "dh", max_length=DEFINITION_HASH_CHARS)
        if not text or named != text_hash(text):
            raise WireError("the text of a definition does not have its hash")
        return Define(named, text)
    object_id = framing.take_str(envelope, "id")
    upto = framing.take_int(envelope, "upto") if "upto" in envelope else None
    if operation == "delete":
        return Delete(object_id, upto)
    if operation not in ("put", "set"):
        raise WireError(f"unknown change of an object {operation!r}")
    told = framing.take_bool(envelope, "val")
    if attachment and not told:
        raise WireError(f"object {object_id!r} has a value that is none")
    value_bytes = framing.take_int(envelope, "n", low=-1)
    if told and value_bytes != len(attachment):
        raise WireError(f"object {object_id!r} has a value of {len(attachment)} bytes, which is to have {value_bytes}")
    fresh = Set(
        object_id,
        attachment if told else None,
        value_bytes,
        framing.take_str(envelope, "sha", max_length=64, default=""),
        framing.take_int(envelope, "seq", default=0),
        framing.take_int(envelope, "stamp", low=-(2**63)) if "stamp" in envelope else None,
        framing.take_int(envelope, "wall", low=-(2**63), default=0),
        upto,
    )
    if operation == "set":
        return fresh
    kind = framing.take_str(envelope, "kind", max_length=16)
    if kind not in _KINDS:
        raise WireError(f"object {object_id!r} has the unknown kind {kind!r}")
    return Put(
        object_id,
        framing.take_str(envelope, "owner", max_length=64, default=""),
        ObjectKind(kind),
        framing.take_str(envelope, "type", default=""),
        framing.take_str(envelope, "hash", max_length=MAX_HASH_CHARS, default=""),
        framing.take_str(envelope, "dh", max_length=DEFINITION_HASH_CHARS, default=""),
        framing.take_texts(envelope, "attr"),
        fresh.value,
        fresh.value_bytes,
        fresh.value_sha256,
        fresh.seq,
        fresh.ros_stamp_ns,
        fresh.wall_ns,
        upto,
    )


_KINDS: Final = frozenset(ObjectKind)
