"""The registry of cross-reality objects (paper, "Distribution of ROS Data", idea 2).

Topics, transforms, commands, node metadata and terrain patches are wrapped as objects with an owner, a type, its
definition, attributes and a latest value, so that a twin, a remote ROS node and an operator's page read one thing.

Theory of operation
- `put`, `put_stream`, `delete` and `observe` each raise the registry's version by one and stamp the object with it.
  `since(version)` lists what is newer (`change_log`): each changed object once, with its latest state, however often it
  changed. When the log of deletions does not reach back far enough (or the reader comes from another epoch, that is
  another run of the relay), the answer is the whole registry with `resync` set.
- A value up to `max_value_bytes` is kept and shown. Of a larger one the object shows size and SHA-256: `observe` only
  keeps a reference to the body, which costs the hot path nothing, and the hash is worked out when somebody asks. When
  the references held reach `max_held_bytes`, further large bodies are not kept and show no hash.
- A value that came encoded is decoded when somebody asks. Where that must not take long, the reader sets
  `inline_bytes`, lets other threads do what `unread` gives, and asks then; a larger one that is still as it came shows
  its size alone.
- What another relay tells of is shown (`show`) as it was told, until it is put here. `on_deleted` is called of each
  object that is gone: something else of that id may be shown then.
- Topic objects are named `<topic>@<client>`; ids that end in `@<client>` are reserved for that client. Other ids
  belong to whoever puts them first.
"""

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Final

from sern_core.bodies.codecs import Work, decode
from sern_core.objects.change_log import ChangeLog
from sern_core.objects.object_limits import ObjectLimits
from sern_core.objects.values import Entry, ObjectValues
from sern_core.objects.xr_object import ChangedIds, ObjectChanges, XrObject
from sern_core.vocabulary.codec_names import Codec
from sern_core.vocabulary.errors import CodecError, RefusedError
from sern_core.vocabulary.message import COMMAND_TYPES, StreamId, StreamInfo
from sern_core.vocabulary.names import plain_type
from sern_core.vocabulary.types import ClientName, ObjectKind, PriorityClass, TopicName

COMMAND_OBJECT_TYPES: Final = COMMAND_TYPES | {
    "ackermann_msgs/AckermannDrive",
    "ackermann_msgs/AckermannDriveStamped",
    "control_msgs/JointJog",
    "trajectory_msgs/JointTrajectory",
}
"""A topic of class control with one of these types is an object of kind `command`."""
TRANSFORM_TYPES: Final = frozenset({"tf2_msgs/TFMessage", "tf/tfMessage", "geometry_msgs/TransformStamped"})
PATCH_TYPES: Final = frozenset({"map_msgs/OccupancyGridUpdate", "map_msgs/PointCloud2Update"})
"""A topic with one of these types, which change part of a map, is an object of kind `patch`."""


def text_hash(definition: str) -> str:
    """SHA-256 of a definition, hex; empty when there is none."""
    return hashlib.sha256(_utf8(definition)).hexdigest() if definition else ""


class ValueRequest(Work):
    """One large value that another thread is to decode or to hash."""

    def __init__(self, registry: "ObjectRegistry", entry: Entry, body: bytes) -> None:
        self.entry = entry
        self.body = body
        self.codec = entry.codec
        self.raw: bytes | None = body
        self.sha256: str | None = None
        self._registry = registry

    def run(self) -> None:
        limits = self._registry.limits
        if self.codec:
            try:
                self.raw = decode(self.codec, self.body, max_bytes=limits.max_decoded_bytes)
            except CodecError:
                self.raw = None
        if self.raw is not None and len(self.raw) > limits.max_value_bytes:
            self.sha256 = hashlib.sha256(self.raw).hexdigest()

    def done(self, *, now: float) -> None:
        self._registry.have_read(self)


class ObjectRegistry:
    """See the module's text. `epoch` is this run's random number; a reader of another epoch is told to start over."""

    def __init__(self, *, epoch: int = 0, limits: ObjectLimits | None = None) -> None:
        self.epoch = epoch
        self.limits = limits or ObjectLimits()
        self._values = ObjectValues(self.limits)
        self.inline_bytes: int | None = None
        """The largest value that is decoded where it is asked for; None: any."""
        self.on_deleted: Callable[[str], None] = lambda _object_id: None
        """Called when an object is gone; set by the owner."""
        self._entries: dict[str, Entry] = {}
        self._log = ChangeLog(self._entries, epoch=epoch, deletions=self.limits.deletions)
        self._by_stream: dict[StreamId, Entry] = {}
        self._owned: dict[ClientName, set[str]] = {}
        self._bytes_of: dict[ClientName, list[int]] = {}  # of owners: their share of total and held bytes

    # Writing ---------------------------------------------------------------------------------------------------------

    def put(
        self,
        object_id: str,
        *,
        owner: ClientName,
        kind: ObjectKind,
        type_name: str,
        wall_ns: int,
        now: float,
        definition: str = "",
        definition_hash: str = "",
        attributes: Mapping[str, str] | None = None,
        value: bytes | None = None,
        seq: int = 0,
        ros_stamp_ns: int | None = None,
        teller: ClientName | None = None,
    ) -> XrObject:
        """Create or replace an object; `value` None keeps the value that is there. `teller`: see `show`.

        Raises RefusedError with code `not_owner`, `bad_id`, `too_large`, `too_many_objects` or `registry_full`, and
        then changes nothing.
        """
        fields = dict(attributes or {})
        definition_bytes = _size_bytes(definition)
        attribute_bytes = sum(_size_bytes(key) + _size_bytes(text) for key, text in fields.items())
        texts_bytes = _size_bytes(object_id) + _size_bytes(type_name) + _size_bytes(definition_hash)
        fixed_bytes = texts_bytes + definition_bytes + attribute_bytes
        entry = self._entries.get(object_id)
        if entry is not None and entry.owner != owner:
            raise RefusedError(
                "not_owner", f"{owner} may not put {object_id[:80]}: {entry.owner} owns it; choose another id"
            )
        limits = self.limits
        limits.check_id(object_id, owner)
        limits.check_texts(object_id, owner, definition_bytes, len(fields), attribute_bytes)
        if entry is None:
            limits.check_count(object_id, owner, len(self._owned.get(owner, ())))
        old_bytes = 0 if entry is None else entry.fixed_bytes + (0 if value is None else self._values.kept_bytes(entry))
        kept_bytes = 0 if value is None or len(value) > limits.max_value_bytes else len(value)
        more_bytes = fixed_bytes + kept_bytes - old_bytes
        own_bytes = self._bytes_of.get(owner, (0, 0))[0]
        limits.check_room(object_id, owner, more_bytes, own_bytes=own_bytes, total_bytes=self._values.total_bytes)
        if entry is None:
            entry = Entry(object_id, owner, self._bytes_of.setdefault(owner, [0, 0]), now)
            self._entries[object_id] = entry
            self._log.add(entry)
            self._owned.setdefault(owner, set()).add(object_id)
        self._values.count(entry, fixed_bytes - entry.fixed_bytes)
        entry.fixed_bytes = fixed_bytes
        definition_hash = definition_hash or text_hash(definition)
        told = kind, type_name, definition, definition_hash, fields
        redescribed = not entry.version or entry.teller != teller or told != _description(entry)
        self._log.set_kind(entry, kind)
        entry.type_name = type_name
        entry.definition = definition
        entry.definition_hash = definition_hash
        entry.attributes = MappingProxyType(fields)
        if value is not None:
            self._values.keep(entry, value)
            entry.seq = seq
            entry.ros_stamp_ns = ros_stamp_ns
        entry.wall_ns = wall_ns
        entry.teller = teller
        self._log.touch(entry, now)
        if redescribed:
            self._log.redescribed(entry)
        return self._seen(entry)

    def show(self, item: XrObject, *, teller: ClientName, redescribed: bool, now: float) -> None:
        """Create or replace an object as another registry has it, of which `teller` told, with what is known of its
        value. The text of its definition is not kept; `redescribed`: it is another one.

        Raises RefusedError like `put`.
        """
        self.put(
            item.id,
            owner=item.owner,
            kind=item.kind,
            type_name=item.type_name,
            definition_hash=item.definition_hash,
            attributes=item.attributes,
            value=item.value,
            seq=item.seq,
            ros_stamp_ns=item.ros_stamp_ns,
            wall_ns=item.wall_ns,
            now=now,
            teller=teller,
        )
        entry = self._entries[item.id]
        if item.value is None:
            self._values.told(entry, item.value_bytes, item.value_sha256)
            entry.seq, entry.ros_stamp_ns = item.seq, item.ros_stamp_ns
        if redescribed:
            self._log.redescribed(entry)

    def make_room(self, more_bytes: int) -> None:
        """Raise the limit of what all objects may hold: there is one more relay that tells of objects."""
        limits = replace(self.limits, max_total_bytes=self.limits.max_total_bytes + more_bytes)
        self.limits = self._values.limits = limits

    def put_stream(self, stream: StreamInfo, *, wall_ns: int, now: float) -> XrObject:
        """Create or update the object of an announced stream; another boot of its origin starts over, at seq 0
        and without a value.

        Raises RefusedError like `put`.
        """
        spec, info = stream.spec, stream.info
        object_id = topic_object_id(stream.id)
        seen = self.put(
            object_id,
            owner=stream.id.origin,
            kind=kind_of(stream),
            type_name=info.type_name,
            definition=info.definition,
            definition_hash=info.type_hash,
            attributes={
                **stream.attributes,
                "topic": stream.id.topic,
                "class": spec.priority.name.lower(),
                "reliability": spec.reliability.value,
                "durability": spec.durability.value,
                "encoding": info.encoding.value,
            },
            wall_ns=wall_ns,
            now=now,
        )
        entry = self._entries[object_id]
        if entry.stream != stream.id:
            if entry.stream is not None:
                del self._by_stream[entry.stream]
                self._values.forget(entry)
            entry.stream = stream.id
            entry.seq = 0
            self._by_stream[stream.id] = entry
            return self._seen(entry)
        return seen

    def redescribe(self, stream: StreamId, *, now: float) -> None:
        """The text of a stream's definition is known now: whoever has its object is told anew."""
        entry = self._by_stream.get(stream)
        if entry is not None:
            self._log.touch(entry, now)
            self._log.redescribed(entry)

    def observe(
        self,
        stream: StreamId,
        seq: int,
        body: bytes,
        *,
        wall_ns: int,
        now: float,
        ros_stamp_ns: int | None = None,
        codec: int = Codec.NONE,
    ) -> bool:
        """A message of an announced stream went by: keep it as the latest value. Never copies, decodes or raises.

        False when it was not taken: the stream has no object (`put_stream` was refused or not called, or a newer
        boot replaced it), or `seq` is not newer than the value there.
        """
        entry = self._by_stream.get(stream)
        if entry is None or seq <= entry.seq:
            return False
        entry.seq = seq
        entry.wall_ns = wall_ns
        entry.ros_stamp_ns = ros_stamp_ns
        if entry.value_bytes == len(body) and entry.body is not None and not (codec or entry.codec):
            entry.body, entry.sha256 = body, None  # of the same size: what the budgets hold stays
        else:
            self._values.keep(entry, body, codec)
        self._log.touch(entry, now)
        return True

    def delete(self, object_id: str, *, owner: ClientName) -> bool:
        """Delete an object; False when there is none. Raises RefusedError(`not_owner`) for another owner's."""
        entry = self._entries.get(object_id)
        if entry is None:
            return False
        if entry.owner != owner:
            raise RefusedError("not_owner", f"{owner} may not delete {object_id}: {entry.owner} owns it")
        self._delete(entry)
        return True

    def delete_stream(self, stream: StreamId) -> bool:
        """Delete the object of a withdrawn stream; False when it has none (or a newer boot has taken it over)."""
        entry = self._by_stream.get(stream)
        if entry is None:
            return False
        self._delete(entry)
        return True

    def delete_owned(self, owner: ClientName) -> tuple[str, ...]:
        """Delete everything of an owner that is gone for good; the ids, sorted."""
        ids = tuple(sorted(self._owned.get(owner, ())))
        for object_id in ids:
            self._delete(self._entries[object_id])
        return ids

    # Reading ---------------------------------------------------------------------------------------------------------

    @property
    def version(self) -> int:
        return self._log.version

    @property
    def described_version(self) -> int:
        """The version of the last change of more than a value."""
        return self._log.described_version

    @property
    def total_bytes(self) -> int:
        """Bytes that count against `max_total_bytes`."""
        return self._values.total_bytes

    @property
    def held_bytes(self) -> int:
        """Bytes of large values that are only referenced."""
        return self._values.held_bytes

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, object_id: str, *, valued: bool = True) -> XrObject | None:
        """An object; not `valued`: as if it had no value, which need not be read then."""
        entry = self._entries.get(object_id)
        if entry is None:
            return None
        return self._seen(entry, valued=valued)

    def described(self, object_id: str) -> int:
        """The version in which anything but its value has changed last; 0: there is no such object."""
        entry = self._entries.get(object_id)
        return 0 if entry is None else entry.described

    def select(self, *, kind: ObjectKind | None = None, owner: ClientName | None = None) -> tuple[XrObject, ...]:
        """Objects of a kind and an owner (None: any), by id."""
        ids = self._entries.keys() if owner is None else self._owned.get(owner, set())
        return tuple(
            self._seen(self._entries[object_id])
            for object_id in sorted(ids)
            if kind is None or self._entries[object_id].kind is kind
        )

    def named(self, *, owner: ClientName | None = None, topic: TopicName | None = None) -> list[str]:
        """Ids of the objects of an owner, and of those of a topic (None: any)."""
        if topic is None:
            return list(self._entries if owner is None else self._owned.get(owner, ()))
        owners = self._owned if owner is None else (owner,)
        return [object_id for name in owners if (object_id := f"{topic}@{name}") in self._entries]

    def about(self, object_id: str) -> tuple[ObjectKind, ClientName, StreamId | None] | None:
        """Kind, owner and the stream an object stands for, if any; None: there is no such object."""
        entry = self._entries.get(object_id)
        return None if entry is None else (entry.kind, entry.owner, entry.stream)

    def teller(self, object_id: str) -> ClientName | None:
        """The peer that told of the object that is shown; None: it was put here, or there is none."""
        entry = self._entries.get(object_id)
        return None if entry is None else entry.teller

    def unread(
        self,
        *,
        kind: ObjectKind | None = None,
        owner: ClientName | None = None,
        topic: TopicName | None = None,
        version: int = 0,
    ) -> list[ValueRequest]:
        """What has to be done before the values of these objects, changed after `version`, can be told. Nothing while
        `inline_bytes` is None."""
        found: list[ValueRequest] = []
        entries: Iterable[Entry] = reversed(self._log.newer(version, None if kind is None else (kind,)))
        if topic is not None:
            entries = [self._entries[object_id] for object_id in self.named(owner=owner, topic=topic)]
        for entry in entries:
            wanted = entry.version > version and kind in (None, entry.kind) and owner in (None, entry.owner)
            if wanted and entry.body is not None and entry.sha256 is None and self._is_long(entry):
                found.append(ValueRequest(self, entry, entry.body))
        return found

    def have_read(self, request: ValueRequest) -> None:
        """Take what a request found out, unless the object has another value by now, or is gone."""
        entry = request.entry
        if entry.body is not request.body or self._entries.get(entry.id) is not entry:
            return
        self._values.forget(entry)
        if request.raw is None:
            return
        if request.sha256 is None:
            self._values.keep(entry, request.raw)
        else:
            entry.value_bytes, entry.sha256 = len(request.raw), request.sha256

    def since(self, version: int, *, epoch: int | None = None) -> ObjectChanges:
        """What changed after `version`; start with 0. `epoch` None: the reader knows that it is this run."""
        changed = self.changed(version, epoch=epoch)
        return ObjectChanges(
            changed.epoch,
            changed.version,
            changed.resync,
            tuple(self._seen(self._entries[object_id]) for object_id in changed.updated),
            changed.deleted,
        )

    def changed(
        self, version: int, *, epoch: int | None = None, kinds: Collection[ObjectKind] | None = None
    ) -> ChangedIds:
        """`since` for who looks at the objects one by one later on, those of some kinds or all. One that is gone by
        then is among those deleted after the version given here; one that has changed is told again."""
        return self._log.changed(version, epoch=epoch, kinds=kinds)

    def validate(self) -> None:
        """Check counts, sums and orders against the objects; raises AssertionError."""
        entries = self._entries
        self._values.validate(entries.values())
        for owner, (own_bytes, own_held_bytes) in self._bytes_of.items():
            mine = [entry for entry in entries.values() if entry.owner == owner]
            assert own_bytes == sum(entry.fixed_bytes + self._values.kept_bytes(entry) for entry in mine), (
                "bytes of an owner"
            )
            assert own_held_bytes == sum(map(self._values.referenced_bytes, mine)), "held bytes of an owner"
            assert own_bytes <= self.limits.max_bytes_per_owner, "an owner has too much"
            assert own_held_bytes <= self.limits.max_held_per_owner, "an owner holds too much"
        assert self._bytes_of.keys() == self._owned.keys(), "owners by bytes"
        self._log.validate()
        assert {entry.id for entry in entries.values()} == set().union(*self._owned.values()), "owners"
        assert all(self._owned.values()), "an owner of nothing"
        assert {entry.stream: entry for entry in entries.values() if entry.stream} == self._by_stream, "streams"

    # Internals -------------------------------------------------------------------------------------------------------

    def _delete(self, entry: Entry) -> None:
        self._values.forget(entry)
        self._values.count(entry, -entry.fixed_bytes)
        if entry.stream is not None:
            del self._by_stream[entry.stream]
        del self._entries[entry.id]
        owned = self._owned[entry.owner]
        owned.discard(entry.id)
        if not owned:
            del self._owned[entry.owner], self._bytes_of[entry.owner]
        self._log.deleted(entry)
        self.on_deleted(entry.id)

    def _is_long(self, entry: Entry) -> bool:
        """Whether telling the value takes longer than it may where somebody asks."""
        return self.inline_bytes is not None and self._values.claimed_bytes(entry) > self.inline_bytes

    def _seen(self, entry: Entry, *, valued: bool = True) -> XrObject:
        long = valued and self._is_long(entry)
        if valued and not long:
            self._values.read(entry)
        value_bytes = self._values.claimed_bytes(entry) if long else entry.value_bytes
        return XrObject(
            id=entry.id,
            owner=entry.owner,
            kind=entry.kind,
            type_name=entry.type_name,
            definition=entry.definition,
            definition_hash=entry.definition_hash,
            attributes=entry.attributes,
            value=entry.body if valued and not long else None,
            value_bytes=value_bytes if valued else -1,
            value_sha256=entry.sha256 if valued else None,
            seq=entry.seq if valued else 0,
            ros_stamp_ns=entry.ros_stamp_ns if valued else None,
            wall_ns=entry.wall_ns if valued else 0,
            created_s=entry.created_s,
            updated_s=entry.updated_s,
            version=entry.version,
        )


def _description(entry: Entry) -> tuple[object, ...]:
    return entry.kind, entry.type_name, entry.definition, entry.definition_hash, entry.attributes


def _utf8(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _size_bytes(text: str) -> int:
    return len(_utf8(text))


def topic_object_id(stream: StreamId) -> str:
    """The id of a stream's object: one per (client, topic), the same for every boot."""
    return f"{stream.topic}@{stream.origin}"


def kind_of(stream: StreamInfo) -> ObjectKind:
    """`command` for class control topics of command types, `transform` for tf, `patch` for parts of maps, `topic`
    otherwise."""
    type_name = plain_type(stream.info.type_name)
    if stream.spec.priority is PriorityClass.CONTROL and type_name in COMMAND_OBJECT_TYPES:
        return ObjectKind.COMMAND
    if type_name in TRANSFORM_TYPES:
        return ObjectKind.TRANSFORM
    if type_name in PATCH_TYPES:
        return ObjectKind.PATCH
    return ObjectKind.TOPIC
