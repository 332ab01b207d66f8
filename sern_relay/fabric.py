"""This relay's place among others: its port, and a hop to each that is there. Imported only where a relay's file has
`fabric`.
"""

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sern_core.relay import peer_rules
from sern_core.relay.access import AccessRule
from sern_core.relay.hub import Hub
from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.errors import RemoteError
from sern_core.vocabulary.names import peer_name
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.config.fabric import FabricSection
from sern_runtime.fabric.hop import FabricHop
from sern_runtime.fabric.port import FabricPort, PeerRelay
from sern_runtime.fabric.sealed_port import port_of
from sern_runtime.fabric.zenoh_port import options_of

_log = logging.getLogger(__name__)


def rules_hash(rules: Sequence[AccessRule]) -> str:
    """The same for relays that grant the same: what differs in it may differ in what it grants."""
    return peer_rules.rules_hash(peer_rules.rules_text(rules))


class RelayFabric:
    """Made from the file, `start` once, `close` once. It is told by its port (`FabricEvents`), and has a hop to each
    relay that is there."""

    def __init__(
        self,
        section: FabricSection,
        base_dir: Path,
        hub: Hub,
        *,
        rules: Sequence[AccessRule],
    ) -> None:
        """Raises ConfigError where zenoh is not installed, or a certificate that is needed cannot be read."""
        self.peers: dict[ClientName, PeerRelay] = {}
        self.unknown = 0
        """Datagrams of relays that nobody has told of yet, or that are gone."""
        self._hub = hub
        self._expected = section.others
        self._hops: dict[ClientName, tuple[HubPort, FabricHop]] = {}
        options = options_of(section, base_dir, name=hub.name, boot=hub.boot, rules=rules_hash(rules))
        self.port: FabricPort = port_of(options, self)

    async def start(self) -> None:
        """Raises ConfigError of one line."""
        await self.port.start()

    async def close(self) -> None:
        for name in list(self._hops):
            self._cut(name)
        await self.port.close()

    def flush(self) -> None:
        """Send what there is for other relays."""
        for end, hop in self._hops.values():
            if end.dirty:
                hop.kick()

    def reached(self) -> dict[ClientName, bool]:
        """Whether there is a session with each relay that may take part, or that has been there."""
        names = {*(self._expected or ()), *(peer[1:] for peer in self._hub.peers.names)}
        links = {name: self._hub.links.get(peer_name(name)) for name in sorted(names)}
        return {ClientName(name): link is not None and link.established for name, link in links.items()}

    def clients(self) -> dict[ClientName, int]:
        """How many clients are at each other relay."""
        return {ClientName(peer[1:]): count for peer, count in self._hub.peers.counts().items()}

    def rules_differ(self) -> dict[ClientName, bool]:
        """Whether each other relay has other rules than this one, of those that have said."""
        said = {peer: self._hub.rules.differ(peer) for peer in sorted(self._hub.peers.names)}
        return {ClientName(peer[1:]): differ for peer, differ in said.items() if differ is not None}

    # --- FabricEvents -----------------------------------------------------------------------------------------------

    def peer_up(self, peer: PeerRelay) -> None:
        self._cut(peer.name)  # of an earlier process of its name
        self.peers[peer.name] = peer
        _log.info("relay %s is there", peer.name)
        end = self._hub.add_peer(peer.name, peer.name)
        hop = FabricHop(self.port, peer.name, end, on_unreadable=partial(self._unreadable, peer.name))
        self._hops[peer.name] = end, hop
        end.connected(now=clock.now())
        hop.kick()

    def peer_down(self, name: ClientName, boot: int) -> None:
        known = self.peers.get(name)
        if known is not None and known.boot == boot:
            del self.peers[name]
            self._cut(name)
            _log.warning("relay %s is gone, or out of reach", name)

    def arrived(self, source: ClientName, datagram: bytes) -> None:
        pair = self._hops.get(source)
        if pair is None:
            self.unknown += 1
        else:
            pair[1].arrived(datagram)
            self._hub.after()  # what it brought is for other ends: they are to send it now, and not at the next sweep

    def _cut(self, name: ClientName) -> None:
        pair = self._hops.pop(name, None)
        if pair is not None:
            end, hop = pair
            hop.close()
            end.disconnected(now=clock.now())

    def _unreadable(self, name: ClientName, error: RemoteError) -> None:
        _log.warning("relay %s: %s", name, error)
