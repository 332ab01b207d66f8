"""Which objects of a registry have changed since a version. Pure.

Each change raises the version by one and stamps its object with it. The objects of each kind lie in the order of their
last change, so that what is newer than a version is found without a look at the rest. Only deletions need a log; who
asks for more than it has, or comes from another epoch, has to take the whole registry.
"""

from collections import OrderedDict, deque
from collections.abc import Collection
from operator import attrgetter

from sern_core.objects.values import Entry
from sern_core.objects.xr_object import ChangedIds
from sern_core.vocabulary.types import ObjectKind


class ChangeLog:
    """Gives objects their versions, and says what is newer than one. `entries` are the objects by id, as the registry
    keeps them; `epoch` is this run's random number, `deletions` how many deletions are remembered."""

    def __init__(self, entries: dict[str, Entry], *, epoch: int, deletions: int) -> None:
        self.epoch = epoch
        self.version = 0
        """How many changes there were: the version of the last one."""
        self.described_version = 0
        """The version of the last change of more than a value."""
        self._entries = entries
        self._by_kind: dict[ObjectKind, OrderedDict[str, Entry]] = {  # least recently changed first
            kind: OrderedDict() for kind in ObjectKind
        }
        self._deletions: deque[tuple[int, str, ObjectKind]] = deque(maxlen=deletions)
        self._forgotten_version = 0  # deletions up to this version may have left the log

    # Writing ---------------------------------------------------------------------------------------------------------

    def add(self, entry: Entry) -> None:
        """Take an object in that is new; `touch` gives it its version."""
        self._by_kind[entry.kind][entry.id] = entry

    def set_kind(self, entry: Entry, kind: ObjectKind) -> None:
        """Make an object one of another kind; `touch` puts it in its place there."""
        if entry.kind is not kind:
            del self._by_kind[entry.kind][entry.id]
            self._by_kind[kind][entry.id] = entry
            entry.kind = kind

    def touch(self, entry: Entry, now: float) -> None:
        """Note that an object changes."""
        self.version += 1
        entry.version = self.version
        entry.updated_s = now
        self._by_kind[entry.kind].move_to_end(entry.id)

    def redescribed(self, entry: Entry) -> None:
        """Note that the change just made is one of more than a value."""
        entry.described = self.described_version = entry.version

    def deleted(self, entry: Entry) -> None:
        """Note that an object is gone; the registry has taken it out of `entries`."""
        del self._by_kind[entry.kind][entry.id]
        self.version += 1
        self.described_version = self.version
        if len(self._deletions) == self._deletions.maxlen:
            self._forgotten_version = self._deletions[0][0] if self._deletions else self.version
        self._deletions.append((self.version, entry.id, entry.kind))

    # Reading ---------------------------------------------------------------------------------------------------------

    def changed(self, version: int, *, epoch: int | None, kinds: Collection[ObjectKind] | None) -> ChangedIds:
        """The ids of what has changed after a version of an epoch (None: this one), of some kinds or all."""
        foreign = version < 0 or version > self.version or (epoch is not None and epoch != self.epoch)
        if foreign or (version and version < self._forgotten_version):
            whole = tuple(entry.id for entry in self.newer(0, kinds))
            return ChangedIds(self.epoch, self.version, True, whole, (), whole)
        updated = self.newer(version, kinds)
        gone: dict[str, int] = {}
        for at, object_id, kind in reversed(self._deletions) if version else ():
            if at <= version:
                break
            if object_id not in self._entries and (kinds is None or kind in kinds):
                gone.setdefault(object_id, at)
        ids = tuple(entry.id for entry in updated)
        in_order = ids
        if gone:
            changes = [(entry.version, entry.id) for entry in updated] + [(at, each) for each, at in gone.items()]
            in_order = tuple(object_id for _version, object_id in sorted(changes))
        return ChangedIds(self.epoch, self.version, False, ids, tuple(reversed(gone)), in_order)

    def newer(self, version: int, kinds: Collection[ObjectKind] | None) -> list[Entry]:
        """What has changed after a version and is still there, the oldest change first."""
        found: list[Entry] = []
        for kind, entries in self._by_kind.items():
            if kinds is not None and kind not in kinds:
                continue
            for entry in reversed(entries.values()):
                if entry.version <= version:
                    break
                found.append(entry)
        found.sort(key=attrgetter("version"))
        return found

    def validate(self) -> None:
        """Check kinds and orders against the objects; raises AssertionError."""
        entries = self._entries
        assert sum(map(len, self._by_kind.values())) == len(entries), "objects by kind"
        for kind, some in self._by_kind.items():
            versions = [entry.version for entry in some.values()]
            assert all(entry.kind is kind and entries[entry.id] is entry for entry in some.values()), "a kind"
            assert versions == sorted(set(versions)), "the order of changes"
            assert not versions or versions[-1] <= self.version, "a version from the future"
            assert all(entry.described <= self.described_version for entry in some.values()), "a later description"
