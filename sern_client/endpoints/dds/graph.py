"""The ROS 2 graph as discovery tells it: participants, nodes, readers and writers, and what to make of them.

No DDS in here: it is told what came and went, and answers with topics, services and complaints.
"""

import logging
from bisect import bisect_left, insort
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Protocol
from uuid import UUID

from sern_client.endpoints.dds import names, node_info, qos
from sern_client.endpoints.dds.names import Role, RosName
from sern_client.endpoints.dds.node_info import Node
from sern_client.endpoints.dds.qos import EndpointQos
from sern_core.vocabulary.types import TopicName

FAST_DDS: Final = b"\x01\x0f"
"""How the GUIDs of eProsima's DDS begin: their vendor id."""
MAX_COMPLAINTS: Final = 1000
MAX_IGNORED_BEFORE: Final = 1000
MAX_EARLY_NODES: Final = 64
"""Participants that are not known, and of whose nodes is kept what was said."""

MAX_UNNAMED: Final = 64
"""Lines that wait for the name of a node; one more is said without."""
NAME_WAIT_S: Final = 5.0
"""How long a line waits for it. A node tells its name after its readers and writers have been found; where the first
try is lost, Fast DDS asks after 3 s whether all have it."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Participant:
    """A process's presence in a domain. `sern`: what a SERN endpoint calls itself, empty for all others."""

    guid: UUID
    name: str = ""
    sern: str = ""


@dataclass(frozen=True, slots=True)
class Remote:
    """A reader or writer of somebody else. `handle`: what samples of a writer are marked with."""

    guid: UUID
    participant: UUID
    writer: bool
    topic: str
    type_name: str
    qos: EndpointQos
    handle: int = 0


@dataclass(slots=True)
class Local:
    """A reader or writer of ours, to be compared with the others' on its topic."""

    guid: UUID
    writer: bool
    topic: str
    type_name: str
    qos: EndpointQos
    used_by: str = ""


def puts_header(remote: Remote) -> bool:
    """Whether a service's reader or writer has the call's number in its messages, as rmw_cyclonedds does it.

    rmw_fastrtps has it in RTPS inline QoS instead, which Cyclone DDS neither shows nor sends.
    """
    return bool(remote.qos.service_id) or remote.guid.bytes[:2] != FAST_DDS


def _by_guid(remote: Remote) -> bytes:
    return remote.guid.bytes


class GraphEvents(Protocol):
    def writers_changed(self, name: RosName, topic: str) -> None:
        """Somebody else's writers on a topic are others than before."""

    def services_changed(self, name: TopicName) -> None:
        """Readers or writers of a service's topics are others than before."""


@dataclass
class Graph:
    """`accept_bridged`: topics of other SERN endpoints count as topics of this site; those of `own_guard` never do."""

    own: UUID
    events: GraphEvents
    accept_bridged: bool = False
    own_guard: str = ""
    modern: bool = False
    """Whether anybody of ROS 2 Iron or later was here: they say the hashes of their types, and read our node
    information. Before Iron it had another layout, and what is in a wrong one may end a node."""
    modern_seen: Callable[[], None] = lambda: None
    """Called when the first of them is seen."""
    later: Callable[[float, Callable[[], None]], object] | None = None
    """`later(delay_s, call)` calls once after a delay. Without it nothing waits for the name of a node."""
    participants: dict[UUID, Participant] = field(default_factory=dict)
    remotes: dict[UUID, Remote] = field(default_factory=dict)
    locals: dict[UUID, Local] = field(default_factory=dict)
    ignored: set[int] = field(default_factory=set)
    """Handles of the writers whose samples are not to be taken."""
    _ignored_before: dict[int, None] = field(default_factory=dict)
    """Those that went last: what they wrote may still be on its way."""
    complaints: dict[tuple[UUID, UUID], str] = field(default_factory=dict)
    """Who does not get, or give, what: by the two endpoints, in one line each."""
    _nodes: dict[UUID, list[Node]] = field(default_factory=dict)
    """Nodes of each participant, as they were last said."""
    _node_names: dict[UUID, dict[bytes, str]] = field(default_factory=dict)
    """Nodes by their readers and writers, for participants that were asked about: a body may have 3000 nodes."""
    _early_nodes: dict[UUID, list[Node]] = field(default_factory=dict)
    """The same for participants that are not known yet, or never will be."""
    _of_participant: dict[UUID, dict[UUID, None]] = field(default_factory=dict)
    """Readers and writers, in the order in which they came."""
    _writers: dict[int, Remote] = field(default_factory=dict)
    """Writers by their handles."""
    _told: set[UUID] = field(default_factory=set)
    """Readers and writers that count as of this site: as such they are told when they go, whatever is true by then."""
    _on_topic: dict[tuple[str, bool], list[Remote]] = field(default_factory=dict)
    """Readers and writers of this site, in the order of their GUIDs; by topic, and whether they write."""
    _locals_on: dict[str, dict[UUID, Local]] = field(default_factory=dict)
    _complained: dict[UUID, set[tuple[UUID, UUID]]] = field(default_factory=dict)
    _unnamed: dict[tuple[Hashable, ...], tuple[Remote, Callable[[], None]]] = field(default_factory=dict)
    """What is to be said once it is known of which node these are."""

    # What happens

    def participant_added(self, participant: Participant) -> None:
        """It came, or says something else of itself than before, which may change whose its readers and writers are."""
        self.participants[participant.guid] = participant
        if participant.sern and participant.guid != self.own:  # discovery shows us ourselves too
            self._is_modern()
        early = self._early_nodes.pop(participant.guid, None)
        if early is not None:
            self._nodes[participant.guid] = early
        mine = [self.remotes[guid] for guid in self._of_participant.get(participant.guid, ())]
        moved = [remote for remote in mine if self.foreign(remote) is not self._is_foreign(remote)]
        for remote in moved:
            self._take_out(remote.guid)
            self._put_in(remote)
        self._tell(moved)

    def participant_removed(self, guid: UUID) -> None:
        """Its readers and writers go with it; of each topic and service that is told once."""
        mine = [self.remotes[one] for one in self._of_participant.get(guid, ())]
        told = [remote for remote in mine if self.foreign(remote)]
        for remote in mine:
            self._take_out(remote.guid)
        self.participants.pop(guid, None)
        self._nodes.pop(guid, None)
        self._node_names.pop(guid, None)
        self._tell(told)

    def remote_added(self, remote: Remote) -> None:
        """One that is known already and is not the same any more went and came again."""
        if remote.participant == self.own or self.remotes.get(remote.guid) == remote:
            return
        self.remote_removed(remote.guid)
        self._put_in(remote)
        if self.foreign(remote):
            self._tell([remote])

    def remote_removed(self, guid: UUID) -> None:
        remote = self.remotes.get(guid)
        if remote is None:
            return
        told = self.foreign(remote)
        self._take_out(guid)
        if told:
            self._tell([remote])

    def local_added(self, local: Local) -> None:
        self.locals[local.guid] = local
        self._locals_on.setdefault(local.topic, {})[local.guid] = local
        for remote in self._on_topic.get((local.topic, not local.writer), ()):
            self._compare(local, remote)

    def local_removed(self, guid: UUID) -> None:
        local = self.locals.pop(guid, None)
        if local is None:
            return
        here = self._locals_on[local.topic]
        del here[guid]
        if not here:
            del self._locals_on[local.topic]
        self._forget(guid)

    def nodes_of(self, participant: UUID, nodes: list[Node]) -> None:
        """What is said of a participant's nodes. Anybody can say it of any participant, known or invented."""
        if participant in self.participants:
            self._nodes[participant] = nodes
            self._node_names.pop(participant, None)
            waiting = [about for about, (remote, _) in self._unnamed.items() if remote.participant == participant]
            for about in waiting:
                if self._node(self._unnamed[about][0]) is not None:
                    self._say(about)
            return
        self._early_nodes.pop(participant, None)
        self._early_nodes[participant] = nodes
        if len(self._early_nodes) > MAX_EARLY_NODES:
            del self._early_nodes[next(iter(self._early_nodes))]

    # What it amounts to

    def ignores(self, handle: int) -> bool:
        """Whether samples of the writer with this handle are not to be taken, of one that has just gone too."""
        return handle in self.ignored or handle in self._ignored_before

    def foreign(self, remote: Remote) -> bool:
        """Whether it counts as of this site, and not of a SERN endpoint that brings it from elsewhere."""
        return remote.guid in self._told

    def writers(self, topic: str) -> list[Remote]:
        """The writers of this site on a DDS topic, in the order of their GUIDs."""
        return list(self._on_topic.get((topic, True), ()))

    def readers(self, topic: str) -> list[Remote]:
        return list(self._on_topic.get((topic, False), ()))

    def writer(self, handle: int) -> Remote | None:
        """Whose samples are marked with this handle; None when it has gone."""
        return self._writers.get(handle)

    def owner(self, remote: Remote) -> str:
        """Whose it is, in words: the node where that is known, else the participant."""
        node = self._node(remote)
        if node is not None:
            return f"node {names.cut(node)}"
        participant = self.participants.get(remote.participant)
        name = participant.name if participant is not None and participant.name else "without a name"
        return f"participant {names.cut(name)} ({remote.participant.hex[:24]})"

    def when_named(self, remote: Remote, say: Callable[[], None], *about: Hashable) -> None:
        """Call `say` as soon as it is known of which node this is, or NAME_WAIT_S from now; once for all that is said
        `about` the same meanwhile."""
        if about in self._unnamed:
            return
        if self.later is None or self._node(remote) is not None or len(self._unnamed) >= MAX_UNNAMED:
            say()
        else:
            self._unnamed[about] = remote, say
            self.later(NAME_WAIT_S, partial(self._say, about))

    def end(self) -> None:
        """Nothing is said any more."""
        self.later = None
        self._unnamed.clear()

    # In here

    def _node(self, remote: Remote) -> str | None:
        known = self._node_names.get(remote.participant)
        if known is None and (nodes := self._nodes.get(remote.participant)) is not None:
            known = self._node_names[remote.participant] = node_info.by_entity(nodes)
        return known.get(remote.guid.bytes) if known else None

    def _say(self, about: tuple[Hashable, ...]) -> None:
        _, say = self._unnamed.pop(about, (None, None))
        if say is not None:
            say()

    def _is_foreign(self, remote: Remote) -> bool:
        """Whether it would count as of this site by what its participant says now."""
        participant = self.participants.get(remote.participant)
        if participant is None or not participant.sern:
            return True
        return self.accept_bridged and participant.sern != self.own_guard

    def _is_modern(self) -> None:
        if not self.modern:
            self.modern = True
            self.modern_seen()

    def _put_in(self, remote: Remote) -> None:
        self.remotes[remote.guid] = remote
        if remote.qos.type_hash:
            self._is_modern()
        self._of_participant.setdefault(remote.participant, {})[remote.guid] = None
        if remote.writer:
            self._writers[remote.handle] = remote
        if not self._is_foreign(remote):
            if remote.writer:
                self.ignored.add(remote.handle)
            return
        self._ignored_before.pop(remote.handle, None)
        self._told.add(remote.guid)
        insort(self._on_topic.setdefault((remote.topic, remote.writer), []), remote, key=_by_guid)
        for local in self._locals_on.get(remote.topic, {}).values():
            self._compare(local, remote)

    def _take_out(self, guid: UUID) -> None:
        remote = self.remotes.pop(guid)
        mine = self._of_participant[remote.participant]
        del mine[guid]
        if not mine:
            del self._of_participant[remote.participant]
        if remote.writer:
            self._writers.pop(remote.handle, None)
        if remote.handle in self.ignored and remote.writer:
            self.ignored.discard(remote.handle)
            self._ignored_before[remote.handle] = None
            if len(self._ignored_before) > MAX_IGNORED_BEFORE:
                del self._ignored_before[next(iter(self._ignored_before))]
        if guid not in self._told:
            return
        self._told.discard(guid)
        found = self._on_topic[remote.topic, remote.writer]
        del found[bisect_left(found, guid.bytes, key=_by_guid)]
        if not found:
            del self._on_topic[remote.topic, remote.writer]
        self._forget(guid)

    def _tell(self, changed: Iterable[Remote]) -> None:
        """Each topic with other writers than before, and each service, once."""
        topics = {(remote.topic, remote.writer): None for remote in changed}
        services: dict[TopicName, None] = {}
        for topic, writer in topics:
            name = names.from_dds(topic)
            if name is None:
                continue
            if name.role is not Role.TOPIC:
                services[name.name] = None
            elif writer:
                self.events.writers_changed(name, topic)
        for service in services:
            self.events.services_changed(service)

    def _forget(self, guid: UUID) -> None:
        for pair in self._complained.pop(guid, ()):
            del self.complaints[pair]
            for other in pair:
                if other != guid:
                    self._complained[other].discard(pair)
                    if not self._complained[other]:
                        del self._complained[other]

    def _compare(self, local: Local, remote: Remote) -> None:
        if remote.writer is local.writer:
            return
        mine, theirs = local.qos, remote.qos
        found = qos.mismatches(mine, theirs) if local.writer else qos.mismatches(theirs, mine)
        if remote.type_name != local.type_name:
            found.insert(0, f"type ({names.cut(remote.type_name)} there, {local.type_name} here)")
        elif mine.type_hash and theirs.type_hash and mine.type_hash != theirs.type_hash:
            found.insert(0, f"version of the type ({names.cut(theirs.type_hash)} there, {mine.type_hash} here)")
        if not found or len(self.complaints) >= MAX_COMPLAINTS:
            return
        ros = names.from_dds(remote.topic)
        what = "subscriber" if local.writer else "publisher"
        pair = local.guid, remote.guid

        def line() -> str:
            return (
                f"{ros.name if ros else remote.topic}: the {what} of {self.owner(remote)} and we do not match: "
                + "; ".join(found)
            )

        def say() -> None:
            if pair in self.complaints:  # neither has gone
                self.complaints[pair] = line()
                _log.warning("%s", self.complaints[pair])

        self.complaints[pair] = line()
        for one in pair:
            self._complained.setdefault(one, set()).add(pair)
        self.when_named(remote, say, pair)
