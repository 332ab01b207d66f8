"""This relay's place among others: its port, and who is there. Imported only where a relay's file has `fabric`.

What arrives is counted and let go: the core does not take streams of other relays yet.
"""

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from sern_core.relay.access import AccessRule
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.fabric import FabricSection
from sern_runtime.fabric.port import Claim, FabricPort, PeerRelay
from sern_runtime.fabric.zenoh_port import ZenohPort, options_of

RULES_DIGITS: Final = 32

_log = logging.getLogger(__name__)


def rules_hash(rules: Sequence[AccessRule]) -> str:
    """The same for relays that grant the same: what differs in it may differ in what it grants."""
    text = json.dumps([asdict(rule) for rule in rules], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:RULES_DIGITS]


class RelayFabric:
    """Made from the file, `start` once, `close` once. It is told by its port (`FabricEvents`)."""

    def __init__(
        self,
        section: FabricSection,
        base_dir: Path,
        *,
        name: ClientName,
        boot: int,
        rules: Sequence[AccessRule],
    ) -> None:
        """Raises ConfigError where zenoh is not installed."""
        self.peers: dict[ClientName, PeerRelay] = {}
        self.unused = 0
        """Datagrams that nobody here takes."""
        self._rules = rules_hash(rules)
        self.port: FabricPort = ZenohPort(options_of(section, base_dir, name=name, boot=boot, rules=self._rules), self)

    async def start(self) -> None:
        """Raises ConfigError of one line."""
        await self.port.start()

    async def close(self) -> None:
        await self.port.close()

    def peer_up(self, peer: PeerRelay) -> None:
        self.peers[peer.name] = peer
        _log.info("relay %s is there", peer.name)
        if peer.rules != self._rules:
            _log.warning("relay %s has other access rules than this one", peer.name)

    def peer_down(self, name: ClientName, boot: int) -> None:
        known = self.peers.get(name)
        if known is not None and known.boot == boot:
            del self.peers[name]
            _log.warning("relay %s is gone, or out of reach", name)

    def claimed(self, claim: Claim) -> None:
        """Nobody asks for clients of other relays yet."""

    def released(self, claim: Claim) -> None:
        """As `claimed`."""

    def arrived(self, source: ClientName, datagram: bytes) -> None:
        del source, datagram
        self.unused += 1
