"""What the hub tells its relay: each piece of news goes to the part that it is for, and into the log where nobody else
says it."""

import logging
from collections.abc import Sequence
from typing import Final

from sern_core.vocabulary.key_news import ClientKeys, KeyRevocation
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.names import PEER_SIGN
from sern_core.vocabulary.types import ClientName
from sern_relay.comings import Comings
from sern_relay.keyring import RelayKeyring
from sern_relay.readers import Readers
from sern_relay.revocations import FabricRevocations
from sern_relay.transports import Transports
from sern_runtime.events import EventLog
from sern_runtime.internal_errors import InternalErrors

RULES: Final = "rules"
"""The kind of events of other relays' access rules."""
OTHER_CODE: Final = "other"
REFUSAL_CODES: Final = frozenset({
    "bad_announcement", "bad_id", "bad_name", "bad_object", "bad_pattern", "displaced", "forbidden",
    "bad_rules", "internal_error", "name_taken", "not_owner", "old_boot", "origin", "registry_full", "too_large",
    "too_many_objects", "too_many_patterns", "too_many_rules", "too_many_streams", "type_mismatch",
})  # fmt: skip
"""What a refusal is counted under; a code that a client made up is counted as `other`."""

_log = logging.getLogger(__name__)


class HubNews:
    """The `HubEvents` of a relay. It is there before the hub is, so the owner sets `revocations` once there is a hub,
    and `keyring` as the relay starts; None: not there yet, or the relay has no keys."""

    def __init__(
        self, comings: Comings, readers: Readers, transports: Transports, events: EventLog, errors: InternalErrors
    ) -> None:
        self.revocations: FabricRevocations | None = None
        self.keyring: RelayKeyring | None = None
        self.refusals = dict.fromkeys((*sorted(REFUSAL_CODES), OTHER_CODE), 0)
        """How often something of a client's was refused, by code."""
        self._comings = comings
        self._readers = readers
        self._transports = transports
        self._events = events
        self._errors = errors

    # --- clients ----------------------------------------------------------------------------------------------------

    def client_up(self, client: ClientName, *, resumed: bool) -> None:
        self._comings.up(client, resumed=resumed)

    def client_down(self, client: ClientName, reason: str) -> None:
        self._comings.down(client, reason)
        if self.keyring is not None:
            self.keyring.left(client)

    def went_over(self, client: ClientName, peer: ClientName, *, came: bool) -> None:
        self._comings.went_over(client, peer.removeprefix(PEER_SIGN), came=came)

    def refused(self, client: ClientName, code: str, text: str) -> None:
        self.refusals[code if code in REFUSAL_CODES else OTHER_CODE] += 1
        self._comings.refused(client, code, text)

    def lane_asked(self, client: ClientName, ciphers: list[str]) -> None:
        if self._transports.lanes is not None:
            self._transports.lanes.asked(client, ciphers)

    def lane_closed(self, client: ClientName) -> None:
        if self._transports.lanes is not None:
            self._transports.lanes.closed(client)

    def keys_asked(self, client: ClientName) -> None:
        if self.keyring is not None:
            self.keyring.asked(client)

    def keys_told(self, client: ClientName, keys: ClientKeys) -> None:
        if self.keyring is not None:
            self.keyring.told(client, keys)

    def fault(self, client: ClientName | None, error: Exception) -> None:
        self._errors.core(error, client or "")

    # --- other relays -----------------------------------------------------------------------------------------------

    def peer_up(self, peer: ClientName) -> None:
        _log.info("connected to the relay %s", peer.removeprefix(PEER_SIGN))

    def peer_down(self, peer: ClientName, reason: str) -> None:
        _log.warning("not connected to the relay %s: %s", peer.removeprefix(PEER_SIGN), reason)

    def revoked(self, peer: ClientName, revocations: Sequence[KeyRevocation]) -> None:
        if self.revocations is not None:
            self.revocations.told(peer, revocations)

    def rules_compared(self, peer: ClientName, *, same: bool) -> None:
        relay = peer.removeprefix(PEER_SIGN)
        if same:
            self._events.say(_log, logging.INFO, RULES, relay, "the relay %s has the access rules of this one", relay)
        else:
            words = "the relay %s has other access rules than this one: what goes between them both must grant"
            self._events.say(_log, logging.WARNING, RULES, relay, words, relay)

    # --- streams ----------------------------------------------------------------------------------------------------

    def stream_added(self, stream: StreamInfo) -> None:
        _log.info("%s announces %s (%s)", stream.id.origin, stream.id.topic, stream.info.type_name)
        self._readers.owners_changed()

    def stream_removed(self, stream: StreamInfo) -> None:
        _log.info("%s of %s has ended", stream.id.topic, stream.id.origin)
        self._readers.stream_removed(stream)

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> None:
        self._readers.message(stream, message, now=now)
