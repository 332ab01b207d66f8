"""Objects of the clients of other relays, as those tell of them: kept for each peer, and shown in the registry. Pure.

An object has one writer, the relay that its owner is at. So what a peer tells is shown while the owner is there, and
may have the object by the rules of this relay; the rest is kept without being shown, since who is where and what the
rules say may change after it was told. Nothing is shown in the place of what is here already: an object that a client
of this relay put, or one that stands for a stream which is relayed here. When that goes, what a peer tells is shown.

An owner that goes over to another relay tells that one its objects anew. Until it has done so, for `MOVED_S` at most,
what was shown of it stays.
"""

from collections import Counter
from collections.abc import Callable, Container, Iterator
from typing import Final

from sern_core.objects.changes import Begin, Change, Define, Put, Set
from sern_core.objects.mirror import Mirror, MirrorLimits
from sern_core.objects.registry import ObjectRegistry
from sern_core.objects.xr_object import XrObject
from sern_core.relay.access import AccessTable
from sern_core.relay.object_rights import check_far_right
from sern_core.vocabulary.errors import RefusedError, WireError
from sern_core.vocabulary.names import is_client_name
from sern_core.vocabulary.types import ClientName, TopicName

PEER_BYTES: Final = 32 * 2**20
PEER_LIMITS: Final = MirrorLimits(max_objects=65_536, max_bytes=PEER_BYTES, max_texts_bytes=16 * 2**20)
"""What is kept of one peer. The registry holds so much more for each of them."""
MOVED_S: Final = 10.0
"""For so long what was shown of an owner stays that has gone over to another relay, and has not told that one yet."""
SETTLED_AT_ONCE: Final = 1000
"""Objects that are looked at in one turn where many have changed together: some milliseconds."""
MAX_SAID: Final = 1024
"""Refusals that are said once each; what is beyond is only counted."""


class FarObjects:
    """`home` names the peer that a client is at; `here` holds the clients with a link here, `access` are the rules of
    now. `refused(peer, code, text)` is told what is not shown, each once; `counts` counts every change."""

    def __init__(
        self,
        registry: ObjectRegistry,
        here: Container[ClientName],
        *,
        access: Callable[[], AccessTable],
        home: Callable[[ClientName], ClientName | None],
        refused: Callable[[ClientName, str, str], None],
        counts: Counter[str],
    ) -> None:
        self._registry = registry
        self._here = here
        self._access = access
        self._home = home
        self._refused = refused
        self._counts = counts
        self._mirrors: dict[ClientName, Mirror] = {}
        self._owned: dict[ClientName, dict[ClientName, set[str]]] = {}  # ids by peer and owner
        self._unsettled: dict[str, None] = {}
        self._moving: dict[ClientName, float] = {}  # owners, and until when what is shown of them stays
        self._said: dict[ClientName, set[tuple[ClientName, str]]] = {}  # by peer: owner, and the code of a refusal
        self._now = 0.0
        self.topics: Counter[TopicName] = Counter()
        """Topics of clients of other relays, each with how many objects stand for it."""
        self.on_topic: Callable[[TopicName], None] = lambda _topic: None
        """Called when there is a first object that stands for a topic, and when there is none any more; set by the
        owner."""
        registry.on_deleted = self._freed

    # --- what peers tell ------------------------------------------------------------------------------------------

    def take(self, peer: ClientName, change: Change, *, now: float) -> bool:
        """A peer tells of a change. True: with it all is told for now. Raises WireError for what no relay tells,
        RefusedError for an id that is none, or one object too many."""
        self._now = now
        refused = self._counts.total()
        if isinstance(change, Put):
            if not is_client_name(change.owner):
                raise WireError(f"an object of {change.owner[:64]!r}, who is no client")
            self._registry.limits.check_id(change.object_id, ClientName(change.owner))
        if isinstance(change, (Put, Set)):
            largest = self._registry.limits.max_value_bytes
            if change.value is not None and len(change.value) > largest:
                raise WireError(f"object {change.object_id[:80]!r} has a value of {len(change.value)} bytes")
        mirror = self._mirrors.get(peer)
        if mirror is None:
            mirror = self._mirrors[peer] = Mirror(
                PEER_LIMITS,
                changed=lambda item, before: self._changed(peer, item, before),
                deleted=lambda item: self._deleted(peer, item),
            )
        full, busy = mirror.counts["full"], bool(self._unsettled)
        mirror.apply(change, now=now)
        if mirror.counts["full"] > full:
            raise RefusedError("registry_full", f"{peer[1:]} tells of more objects than are kept of one relay")
        if not busy:  # else `work` comes to it
            self._settle_some(SETTLED_AT_ONCE)
        if self._counts.total() == refused:
            self._counts["taken"] += 1
        return not isinstance(change, (Begin, Define)) and change.upto is not None

    def version(self, peer: ClientName) -> tuple[int, int]:
        """The epoch that the peer tells, and the version up to which it has told everything; 0, 0: it has not begun."""
        mirror = self._mirrors.get(peer)
        return (0, 0) if mirror is None else (mirror.telling, mirror.version)

    def lost(self, peer: ClientName) -> None:
        """The peer is gone for good, and with it all that it told."""
        mirror = self._mirrors.pop(peer, None)
        self._owned.pop(peer, None)
        self._said.pop(peer, None)
        if mirror is not None:
            self._unsettled |= dict.fromkeys(mirror.objects)
            for item in mirror.objects.values():
                self._count_topic(item, -1)

    def _changed(self, peer: ClientName, item: XrObject, before: XrObject | None) -> None:
        owned = self._owned.setdefault(peer, {})
        if before is None or before.owner != item.owner:
            if before is not None:
                self._disown(peer, before)
            owned.setdefault(item.owner, set()).add(item.id)
        if before is None:
            self._count_topic(item, 1)
        elif topic_of(before) != topic_of(item):
            self._count_topic(before, -1)
            self._count_topic(item, 1)
        redescribed = before is None or before.definition is not item.definition
        self._settle(item.id, changed=peer, redescribed=redescribed)

    def _deleted(self, peer: ClientName, item: XrObject) -> None:
        self._disown(peer, item)
        self._count_topic(item, -1)
        self._unsettled[item.id] = None

    def _disown(self, peer: ClientName, item: XrObject) -> None:
        ids = self._owned[peer][item.owner]
        ids.discard(item.id)
        if not ids:
            del self._owned[peer][item.owner]

    def _count_topic(self, item: XrObject, count: int) -> None:
        topic = topic_of(item)
        if topic is None:
            return
        before = self.topics[topic]
        self.topics[topic] += count
        if not self.topics[topic]:
            del self.topics[topic]
        if not before or topic not in self.topics:
            self.on_topic(topic)

    def refuse(self, peer: ClientName, owner: ClientName, code: str, text: str) -> None:
        """Something of what a peer tells is not taken, or not shown: it is counted, and said once."""
        self._counts[code] += 1
        said = self._said.setdefault(peer, set())
        if (owner, code) not in said and len(said) < MAX_SAID:
            said.add((owner, code))
            self._refused(peer, code, text)

    # --- what is shown --------------------------------------------------------------------------------------------

    def moved(self, client: ClientName, *, now: float) -> None:
        """A client has come here, or gone to another relay."""
        if not self._mirrors and self._home(client) is None:
            return  # nothing is shown of others
        home, shown = self._home(client), self._registry.named(owner=client)
        if any(self._registry.teller(object_id) != home for object_id in shown):
            self._moving[client] = now + MOVED_S  # and not only told anew that it is there
        self._unsettled |= dict.fromkeys(shown)
        for owned in self._owned.values():
            self._unsettled |= dict.fromkeys(owned.get(client, ()))
        self.work(now=now)

    def forget(self, client: ClientName) -> None:
        """A client is given up here: what it put is gone. What is at its home is shown."""
        if self._home(client) is None:
            self._registry.delete_owned(client)
        elif client not in self._moving:  # else its new relay may not have told of all
            self._unsettled |= dict.fromkeys(self._registry.named(owner=client))

    def revoke(self) -> None:
        """There are new access rules."""
        for mirror in self._mirrors.values():
            self._unsettled |= dict.fromkeys(mirror.objects)

    def work(self, *, now: float) -> None:
        """Show and hide what is due. Call ten times a second."""
        self._now = now
        for client in [client for client, due_s in self._moving.items() if now >= due_s]:
            del self._moving[client]
            self._unsettled |= dict.fromkeys(self._registry.named(owner=client))
        self._settle_some(SETTLED_AT_ONCE)

    def _settle_some(self, count: int) -> None:
        while self._unsettled and count:
            count -= 1
            object_id = next(iter(self._unsettled))
            del self._unsettled[object_id]
            self._settle(object_id)

    def _freed(self, object_id: str) -> None:
        """An object is gone from the registry."""
        if self._mirrors:
            self._settle(object_id)

    def _settle(self, object_id: str, *, changed: ClientName | None = None, redescribed: bool = True) -> None:
        """Show what is to be shown under this id. `changed`: the peer that has just told of it."""
        registry = self._registry
        about, teller = registry.about(object_id), registry.teller(object_id)
        best = self._best(object_id, teller, changed)
        if about is not None:
            _kind, owner, stream = about
            own = teller is None and self._home(owner) is None
            if stream is not None or own:
                if changed is not None and own and best is not None and best[1].owner != owner:
                    text = f"{best[1].owner} may not put {object_id[:80]}: {owner} owns it here; choose another id"
                    self.refuse(changed, best[1].owner, "not_owner", text)
                return
            if best is None:
                if owner not in self._moving:
                    registry.delete(object_id, owner=owner)
                return
            if best[1].owner != owner:
                registry.delete(object_id, owner=owner)  # `_freed` shows the other one
                return
        if best is None:
            return
        peer, item = best
        if changed is None and teller == peer:
            return  # it is shown as it is
        try:
            registry.show(item, teller=peer, redescribed=redescribed, now=self._now)
        except RefusedError as refusal:
            self.refuse(peer, item.owner, refusal.code, str(refusal))

    def _best(
        self, object_id: str, teller: ClientName | None, changed: ClientName | None
    ) -> tuple[ClientName, XrObject] | None:
        """The peer whose object of this id is to be shown, that of `teller` before others."""
        found: tuple[ClientName, XrObject] | None = None
        for peer, mirror in self._mirrors.items():
            item = mirror.objects.get(object_id)
            if item is None or (found is not None and peer != teller):
                continue
            home = self._home(item.owner)
            # A peer that is reached again says anew who is there: until then it is what it was.
            stays = home is None and peer == teller and item.owner not in self._here
            if (home == peer or stays) and self._granted(peer, item, say=peer == changed):
                found = peer, item
        return found

    def _granted(self, peer: ClientName, item: XrObject, *, say: bool) -> bool:
        try:
            check_far_right(self._access(), item)
        except RefusedError as refusal:
            if say:
                self.refuse(peer, item.owner, refusal.code, str(refusal))
            return False
        return True

    # --- look-ups -------------------------------------------------------------------------------------------------

    def text(self, object_id: str) -> tuple[str, str]:
        """The text of the definition of an object that a peer told of, and its hash; empty: there is none."""
        teller = self._registry.teller(object_id)
        mirror = None if teller is None else self._mirrors.get(teller)
        item = None if mirror is None else mirror.objects.get(object_id)
        if mirror is None or item is None:
            return "", ""
        return item.definition, mirror.text_hash(object_id)

    def shown(self) -> Iterator[XrObject]:
        """Objects of others that are at their relays, without those that are not shown."""
        for peer, mirror in list(self._mirrors.items()):
            for item in list(mirror.objects.values()):
                if self._registry.teller(item.id) == peer:
                    yield item

    def validate(self) -> None:
        """Internal consistency, for tests."""
        topics: Counter[TopicName] = Counter()
        for peer, mirror in self._mirrors.items():
            mirror.validate()
            owned = {object_id: owner for owner, ids in self._owned.get(peer, {}).items() for object_id in ids}
            assert owned == {item.id: item.owner for item in mirror.objects.values()}, f"owners of objects at {peer}"
            topics.update(topic for item in mirror.objects.values() if (topic := topic_of(item)) is not None)
        assert topics == self.topics, "topics of others"
        for object_id in self._registry.named():
            teller, about = self._registry.teller(object_id), self._registry.about(object_id)
            if teller is None or about is None or object_id in self._unsettled or about[1] in self._moving:
                continue
            held = self._mirrors[teller].objects.get(object_id) if teller in self._mirrors else None
            assert held is not None, f"{object_id} is shown, and {teller} does not tell of it"
            assert held.owner == about[1], f"{object_id} is shown as another's"


def topic_of(item: XrObject) -> TopicName | None:
    """The topic that an object stands for; None: none."""
    topic = item.attributes.get("topic")
    return TopicName(topic) if topic is not None and item.id == f"{topic}@{item.owner}" else None
