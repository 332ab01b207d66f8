"""This relay's place among others: its port, and a hop to each that is there. Imported only where a relay's file has
`fabric`.
"""

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

from sern_core.relay.access import AccessRule
from sern_core.relay.hub import Hub
from sern_core.relay.hub_port import HubPort
from sern_core.vocabulary.errors import RemoteError
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.config.fabric import FabricSection
from sern_runtime.fabric.hop import FabricHop
from sern_runtime.fabric.port import FabricPort, PeerRelay
from sern_runtime.fabric.zenoh_port import ZenohPort, options_of

RULES_DIGITS: Final = 32

_log = logging.getLogger(__name__)


def rules_hash(rules: Sequence[AccessRule]) -> str:
    """The same for relays that grant the same: what differs in it may differ in what it grants."""
    text = json.dumps([asdict(rule) for rule in rules], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:RULES_DIGITS]


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
        """Raises ConfigError where zenoh is not installed."""
        self.peers: dict[ClientName, PeerRelay] = {}
        self.unknown = 0
        """Datagrams of relays that nobody has told of yet, or that are gone."""
        self._hub = hub
        self._rules = rules_hash(rules)
        self._hops: dict[ClientName, tuple[HubPort, FabricHop]] = {}
        options = options_of(section, base_dir, name=hub.name, boot=hub.boot, rules=self._rules)
        self.port: FabricPort = ZenohPort(options, self)

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

    # --- FabricEvents -----------------------------------------------------------------------------------------------

    def peer_up(self, peer: PeerRelay) -> None:
        self._cut(peer.name)  # of an earlier process of its name
        self.peers[peer.name] = peer
        _log.info("relay %s is there", peer.name)
        if peer.rules != self._rules:
            _log.warning("relay %s has other access rules than this one", peer.name)
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

    def _cut(self, name: ClientName) -> None:
        pair = self._hops.pop(name, None)
        if pair is not None:
            end, hop = pair
            hop.close()
            end.disconnected(now=clock.now())

    def _unreadable(self, name: ClientName, error: RemoteError) -> None:
        _log.warning("relay %s: %s", name, error)
