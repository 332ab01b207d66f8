"""Who may have which name and stream: our access rules, and those of the relay that a stream comes from. Pure.

Our own rules are about names: a client may have all streams of a name, or none. What the relay that a stream comes from
grants (`sern_core/relay/peer_rights.py`), and whether a stream goes to peers, may differ between streams of one name.
"""

from sern_core.relay.access import AccessTable, Right
from sern_core.relay.interest import NAME_UNITS, WorkMeter
from sern_core.relay.peer_rights import PeerRights
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, TopicName


class StreamRights:
    """What the routing table asks before anybody gets anything. `access` are our own rules; `spent` counts what it
    costs to ask for a peer, which speaks for many clients."""

    def __init__(self, access: AccessTable, spent: WorkMeter) -> None:
        self.access = access
        self.peers: set[ClientName] = set()
        """The names of other relays; set by the owner."""
        self.peer_rights = PeerRights()
        """What other relays' rules grant, and what may go to them."""
        self.via: dict[StreamId, ClientName] = {}
        """The peer that each stream came from, of those that did; kept by the routing table."""
        self._spent = spent

    def may_have(self, client: ClientName, name: TopicName) -> bool:
        """Whether our rules let a client have a topic, or somebody at a peer."""
        if client not in self.peers:
            return self.access.may_subscribe(client, name)
        may, looked = self.peer_rights.may_have(self.access, client, name)
        self._spent.units += NAME_UNITS * looked
        return may

    def may_replay(self, client: ClientName, stream: StreamId) -> bool:
        """Whether the rules let a client have earlier messages of a stream."""
        if client in self.peers:
            return self.peer_rights.may_replay(self.access, client, stream.topic)
        granted = self.peer_rights.grants(self.via.get(stream), client, stream.topic, Right.REPLAY)
        return granted and self.access.may_replay(client, stream.topic)

    def gets(self, client: ClientName, stream: StreamId) -> bool:
        """Whether a subscriber of the stream's name gets the stream."""
        via = self.via.get(stream)
        if client in self.peers:
            return via is None and stream.origin not in self.peer_rights.stays
        return client != stream.origin and self.peer_rights.grants(via, client, stream.topic, Right.SUBSCRIBE)

    def denies(self, client: ClientName, stream: StreamId) -> bool:
        """Whether the rules of the relay that a stream comes from are known, and do not let a client have it."""
        return self.peer_rights.denies(self.via.get(stream), client, stream.topic)
