"""The ROS 2 graph as discovery tells it: participants, nodes, readers and writers, and what to make of them.

No DDS in here: it is told what came and went, and answers with topics, services and complaints.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Protocol
from uuid import UUID

from sern_client.endpoints.dds import names, qos
from sern_client.endpoints.dds.names import Role, RosName
from sern_client.endpoints.dds.qos import EndpointQos
from sern_core.types import TopicName

FAST_DDS: Final = b"\x01\x0f"
"""How the GUIDs of eProsima's DDS begin: their vendor id."""
MAX_COMPLAINTS: Final = 1000

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


class GraphEvents(Protocol):
    def writers_changed(self, name: RosName, topic: str) -> None:
        """Somebody else's writers on a topic are others than before."""

    def services_changed(self, name: TopicName) -> None:
        """Readers or writers of a service's topics are others than before."""


@dataclass
class Graph:
    """`heed_sern`: topics of other SERN endpoints count as topics of this site, but those of `own_guard` never do."""

    own: UUID
    events: GraphEvents
    heed_sern: bool = False
    own_guard: str = ""
    participants: dict[UUID, Participant] = field(default_factory=dict)
    remotes: dict[UUID, Remote] = field(default_factory=dict)
    locals: dict[UUID, Local] = field(default_factory=dict)
    ignored: set[int] = field(default_factory=set)
    """Handles of the writers whose samples are not to be taken."""
    complaints: dict[tuple[UUID, UUID], str] = field(default_factory=dict)
    """Who does not get, or give, what: by the two endpoints, in one line each."""
    _nodes: dict[UUID, dict[UUID, str]] = field(default_factory=dict)
    _by_topic: dict[str, set[UUID]] = field(default_factory=dict)

    # What happens

    def participant_added(self, participant: Participant) -> None:
        self.participants[participant.guid] = participant

    def participant_removed(self, guid: UUID) -> None:
        """Its readers and writers go with it."""
        self.participants.pop(guid, None)
        self._nodes.pop(guid, None)
        for remote in [remote for remote in self.remotes.values() if remote.participant == guid]:
            self.remote_removed(remote.guid)

    def remote_added(self, remote: Remote) -> None:
        if remote.participant == self.own or remote.guid in self.remotes:
            return
        self.remotes[remote.guid] = remote
        if remote.writer and not self.foreign(remote):
            self.ignored.add(remote.handle)
        self._by_topic.setdefault(remote.topic, set()).add(remote.guid)
        for local in self.locals.values():
            self._compare(local, remote)
        self._tell(remote)

    def remote_removed(self, guid: UUID) -> None:
        remote = self.remotes.pop(guid, None)
        if remote is None:
            return
        self.ignored.discard(remote.handle)
        found = self._by_topic[remote.topic]
        found.discard(guid)
        if not found:
            del self._by_topic[remote.topic]
        self._forget(guid)
        self._tell(remote)

    def local_added(self, local: Local) -> None:
        self.locals[local.guid] = local
        for guid in list(self._by_topic.get(local.topic, ())):
            self._compare(local, self.remotes[guid])

    def local_removed(self, guid: UUID) -> None:
        self.locals.pop(guid, None)
        self._forget(guid)

    def nodes_of(self, participant: UUID, nodes: Iterable[tuple[str, list[UUID]]]) -> None:
        """What a participant says of its nodes: full names, and the readers and writers of each."""
        self._nodes[participant] = {guid: name for name, guids in nodes for guid in guids}

    # What it amounts to

    def foreign(self, remote: Remote) -> bool:
        """Whether it is of this site, and not of a SERN endpoint that brings it from elsewhere."""
        participant = self.participants.get(remote.participant)
        if participant is None or not participant.sern:
            return True
        return self.heed_sern and participant.sern != self.own_guard

    def writers(self, topic: str) -> list[Remote]:
        """The writers of this site on a DDS topic, in the order of their GUIDs."""
        return self._of(topic, writers=True)

    def readers(self, topic: str) -> list[Remote]:
        return self._of(topic, writers=False)

    def _of(self, topic: str, *, writers: bool) -> list[Remote]:
        found = (self.remotes[guid] for guid in sorted(self._by_topic.get(topic, ()), key=lambda guid: guid.bytes))
        return [remote for remote in found if remote.writer is writers and self.foreign(remote)]

    def owner(self, remote: Remote) -> str:
        """Whose it is, in words: the node where that is known, else the participant."""
        node = self._nodes.get(remote.participant, {}).get(remote.guid)
        if node is not None:
            return f"node {node}"
        participant = self.participants.get(remote.participant)
        name = participant.name if participant is not None and participant.name else "without a name"
        return f"participant {name} ({remote.participant.hex[:24]})"

    # In here

    def _tell(self, remote: Remote) -> None:
        if not self.foreign(remote):
            return
        name = names.from_dds(remote.topic)
        if name is None:
            return
        if name.role is not Role.TOPIC:
            self.events.services_changed(name.name)
        elif remote.writer:
            self.events.writers_changed(name, remote.topic)

    def _forget(self, guid: UUID) -> None:
        for pair in [pair for pair in self.complaints if guid in pair]:
            del self.complaints[pair]

    def _compare(self, local: Local, remote: Remote) -> None:
        if remote.topic != local.topic or remote.writer is local.writer or not self.foreign(remote):
            return
        mine, theirs = local.qos, remote.qos
        found = qos.mismatches(mine, theirs) if local.writer else qos.mismatches(theirs, mine)
        if remote.type_name != local.type_name:
            found.insert(0, f"type ({remote.type_name} there, {local.type_name} here)")
        elif mine.type_hash and theirs.type_hash and mine.type_hash != theirs.type_hash:
            found.insert(0, f"version of the type ({theirs.type_hash} there, {mine.type_hash} here)")
        if not found or len(self.complaints) >= MAX_COMPLAINTS:
            return
        ros = names.from_dds(remote.topic)
        what = "subscriber" if local.writer else "publisher"
        line = (
            f"{ros.name if ros else remote.topic}: the {what} of {self.owner(remote)} and we do not match: "
            + "; ".join(found)
        )
        self.complaints[local.guid, remote.guid] = line
        _log.warning("%s", line)
