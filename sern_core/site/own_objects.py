"""Cross-reality objects of this client: its metadata, robots, obstacles, patches. They are kept here and told to the
relay, which has them until they are deleted or this client is forgotten."""

from sern_core.link.link import Link
from sern_core.objects.changes import Put, encode, text_hash
from sern_core.objects.feed import ObjectFeed
from sern_core.objects.registry import ObjectRegistry
from sern_core.objects.registry import text_hash as registry_hash
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import ObjectKind


class OwnObjects:
    """What is put is there until it is deleted. Of what changes while there is no link, only the latest is told."""

    def __init__(self, link: Link, *, boot: int) -> None:
        self._link = link
        self.registry = ObjectRegistry(epoch=boot)
        self._feed: ObjectFeed | None = None  # from the first object on

    def put(
        self,
        object_id: str,
        kind: ObjectKind,
        type_name: str,
        *,
        wall_ns: int,
        now: float,
        attributes: dict[str, str] | None = None,
        value: bytes = b"",
        definition: str = "",
        ros_stamp_ns: int | None = None,
    ) -> None:
        """Create or replace one.

        UsageError: its value is larger than the registry's `max_value_bytes`, or its texts fit into no envelope.
        RefusedError: the registry does not take it (`ObjectRegistry.put`). Then nothing has changed.
        """
        registry = self.registry
        if len(value) > registry.limits.max_value_bytes:
            raise UsageError(
                f"object {object_id[:80]}: a value of {len(value)} bytes; at most {registry.limits.max_value_bytes} "
                "are told, publish larger ones as a topic"
            )
        old = registry.get(object_id)
        seq = 1 if old is None else old.seq + 1
        fields = dict(attributes or {})
        told = value or None
        encode(
            Put(
                object_id,
                self._link.end.name,
                kind,
                type_name,
                registry_hash(definition),
                text_hash(definition),
                fields,
                told,
                len(value) if value else -1,
                "",
                seq,
                ros_stamp_ns,
                wall_ns,
                registry.version,
            )
        )
        registry.put(
            object_id,
            owner=self._link.end.name,
            kind=kind,
            type_name=type_name,
            definition=definition,
            attributes=fields,
            value=told,
            seq=seq,
            ros_stamp_ns=ros_stamp_ns,
            wall_ns=wall_ns,
            now=now,
        )
        self.pump(now=now)

    def delete(self, object_id: str, *, now: float) -> bool:
        """False: there is none."""
        deleted = self.registry.delete(object_id, owner=self._link.end.name)
        self.pump(now=now)
        return deleted

    def pump(self, *, now: float) -> None:
        """Tell the relay what is due. Call ten times a second."""
        if self._feed is None:
            if not len(self.registry):
                return
            self._feed = ObjectFeed(
                self.registry, self._link, sees=lambda _id, _kind: True, text_of=lambda item: item.definition, now=now
            )
        self._feed.pump(now=now)

    def lost(self) -> None:
        """The relay has nothing of ours."""
        if self._feed is not None:
            self._feed.restart()

    def delivered(self, channel: OutChannel, *, now: float) -> None:
        if self._feed is not None and self._feed.channel is channel:
            self._feed.pump(now=now)

    def dropped(self, channel: OutChannel) -> bool:
        """Something of a channel will not arrive. Whether it is that of the objects."""
        if self._feed is None or self._feed.channel is not channel:
            return False
        self._feed.dropped()
        return True

    @property
    def settled(self) -> bool:
        """Whether the relay has them all as they are."""
        return self._feed is None or self._feed.settled
