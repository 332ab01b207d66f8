"""What a relay ends because keys, or the names of clients, hold no more."""

import logging
from typing import Final

from sern_core.relay.hub import Hub
from sern_core.vocabulary.names import is_peer
from sern_relay.admission import Admission
from sern_relay.transports import Transports
from sern_runtime import clock
from sern_runtime.events import EventLog

KEY_LOST: Final = "key_lost"
"""The kind of events."""

_log = logging.getLogger(__name__)


class Enforcement:
    """Call `enforce` after `admission` has changed, and `end_lapsed` about once a second: keys also expire."""

    def __init__(self, hub: Hub, admission: Admission, transports: Transports, events: EventLog) -> None:
        self._hub = hub
        self._admission = admission
        self._transports = transports
        self._events = events

    def end_lapsed(self) -> None:
        """Cut the connections that were made with a key that was taken away or has expired. A session that another
        connection holds by now goes on. Whose those are that have not said anything yet is not known: they go, too."""
        lapsed, server = self._admission.take_lapsed(), self._transports.server
        if not lapsed or server is None:
            return
        server.cut_unbound()
        for client, keys in lapsed.items():
            stays = server.session_key(client) in self._admission.valid().get(client, frozenset())
            cut = server.cut_keys(client, keys) if stays else server.cut_client(client)
            words = "%s lost a key; %d connections cut"
            self._events.say(_log, logging.WARNING, KEY_LOST, client, words, client, cut)
            if not stays:
                self._hub.clients.end_session(client, "the key no longer holds", now=clock.now())

    def enforce(self) -> None:
        """End what was made with keys, or under names, that hold no more."""
        if self._transports.server is not None:
            self._transports.server.cut_unbound()  # admitted by the old keys, and silent so far
        self.end_lapsed()
        for client in [name for name in self._hub.links if not (is_peer(name) or self._admission.known(name))]:
            words = "%s is in the directory no more; what was held for it is dropped"
            self._events.say(_log, logging.WARNING, KEY_LOST, client, words, client)
            self._hub.forget(client, "the name is revoked", now=clock.now())
        self._transports.after()
