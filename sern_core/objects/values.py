"""The values of cross-reality objects, within what the registry may hold. Pure.

A value up to `max_value_bytes` is kept. Of a larger one, or one that came encoded, only a reference to the body is
held until somebody asks for it. What the budgets have no room for is told by its size alone.
"""

import hashlib
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from sern_core.bodies.codecs import decode, raw_size
from sern_core.objects.object_limits import ObjectLimits
from sern_core.vocabulary.codec_names import Codec
from sern_core.vocabulary.errors import CodecError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, ObjectKind


class Entry:
    """An object at rest; the hot path writes its value fields only."""

    __slots__ = (
        "attributes",
        "body",
        "codec",
        "created_s",
        "definition",
        "definition_hash",
        "described",
        "fixed_bytes",
        "id",
        "kind",
        "owner",
        "ros_stamp_ns",
        "seq",
        "sha256",
        "share",
        "stream",
        "teller",
        "type_name",
        "updated_s",
        "value_bytes",
        "version",
        "wall_ns",
    )

    def __init__(self, object_id: str, owner: ClientName, share: list[int], now: float) -> None:
        self.id = object_id
        self.owner = owner
        self.share = share  # of the owner, in the registry's total and held bytes
        self.kind = ObjectKind.TOPIC
        self.type_name = ""
        self.definition = ""
        self.definition_hash = ""
        self.attributes: Mapping[str, str] = MappingProxyType({})
        self.body: bytes | None = None  # the value, or a reference to a large one that nobody has hashed yet
        self.codec = 0  # of the body, until somebody asks for the value
        self.value_bytes = -1
        self.sha256: str | None = None
        self.fixed_bytes = 0
        self.seq = 0
        self.ros_stamp_ns: int | None = None
        self.wall_ns = 0
        self.created_s = now
        self.updated_s = now
        self.version = 0
        self.described = 0  # the version of the last change of more than its value
        self.stream: StreamId | None = None
        self.teller: ClientName | None = None  # the peer that told of it; None: its owner is here


class ObjectValues:
    """Sets and forgets values, and counts what they and the other texts of their objects take."""

    def __init__(self, limits: ObjectLimits) -> None:
        self.limits = limits
        self.total_bytes = 0
        """Bytes that count against `max_total_bytes`."""
        self.held_bytes = 0
        """Bytes of large values that are only referenced."""

    def keep(self, entry: Entry, body: bytes, codec: int = Codec.NONE) -> None:
        """Store a value, a reference, or only its size, whichever the budgets allow."""
        limits = self.limits
        self.forget(entry)
        size = len(body)
        own_bytes, own_held_bytes = share = entry.share
        if size <= limits.max_value_bytes and not codec:
            entry.value_bytes = size
            if self.total_bytes + size <= limits.max_total_bytes and own_bytes + size <= limits.max_bytes_per_owner:
                self.total_bytes += size  # `count`, for every message
                share[0] = own_bytes + size
                entry.body = body
            return
        if not codec:
            entry.value_bytes = size
        if self.held_bytes + size <= limits.max_held_bytes and own_held_bytes + size <= limits.max_held_per_owner:
            self._count_held(entry, size)
            entry.body, entry.codec = body, codec

    def told(self, entry: Entry, value_bytes: int, sha256: str | None) -> None:
        """The value is not here, and this is known of it; -1 bytes: nothing."""
        self.forget(entry)
        entry.value_bytes, entry.sha256 = value_bytes, sha256

    def count(self, entry: Entry, nbytes: int) -> None:
        """An object takes so many bytes more."""
        self.total_bytes += nbytes
        entry.share[0] += nbytes

    def _count_held(self, entry: Entry, nbytes: int) -> None:
        self.held_bytes += nbytes
        entry.share[1] += nbytes

    def forget(self, entry: Entry) -> None:
        """The object has no value any more."""
        old = entry.body
        if old is not None:
            size = len(old)
            if not entry.codec and size <= self.limits.max_value_bytes:
                self.total_bytes -= size  # `count`, for every message
                entry.share[0] -= size
            else:
                self._count_held(entry, -size)
            entry.body = None
        entry.codec = 0
        entry.value_bytes = -1
        entry.sha256 = None

    def kept_bytes(self, entry: Entry) -> int:
        """Bytes of a value that is kept."""
        return len(entry.body) if entry.body is not None and not self._is_reference(entry) else 0

    def referenced_bytes(self, entry: Entry) -> int:
        """Bytes of a value that is only referenced."""
        return len(entry.body) if entry.body is not None and self._is_reference(entry) else 0

    def _is_reference(self, entry: Entry) -> bool:
        return bool(entry.codec) or entry.value_bytes > self.limits.max_value_bytes

    def _decode(self, entry: Entry) -> None:
        """Somebody asks for a value that came encoded; what cannot be decoded has no value."""
        body, codec = entry.body, entry.codec
        self.forget(entry)
        if body is not None:
            try:
                raw = decode(codec, body, max_bytes=self.limits.max_decoded_bytes)
            except CodecError:
                return
            self.keep(entry, raw)

    def claimed_bytes(self, entry: Entry) -> int:
        """How large the value is, or says it is; -1 for none."""
        try:
            return -1 if entry.body is None else raw_size(entry.codec, entry.body)
        except CodecError:
            return -1

    def read(self, entry: Entry) -> None:
        """Somebody asks for the value: decode and hash what is not yet. A large one is not needed any more then."""
        if entry.codec:
            self._decode(entry)
        if entry.body is not None and entry.sha256 is None:
            entry.sha256 = hashlib.sha256(entry.body).hexdigest()
            if entry.value_bytes > self.limits.max_value_bytes:
                self._count_held(entry, -entry.value_bytes)
                entry.body = None

    def validate(self, entries: Iterable[Entry]) -> None:
        """Internal consistency, for tests."""
        entries = list(entries)
        kept_bytes = sum(entry.fixed_bytes + self.kept_bytes(entry) for entry in entries)
        assert self.total_bytes == kept_bytes <= self.limits.max_total_bytes, "total bytes"
        assert self.held_bytes == sum(map(self.referenced_bytes, entries)) <= self.limits.max_held_bytes, "held bytes"
