"""/api/clients of a relay: every client that it knows, where it is, how it fares, and who was refused.

Known are the names of the directory of keys, and whoever has a link or had one. A row has `state`:

    connected   it has a session, and answers
    silent      it has a session, and nothing that is sent to it is acknowledged
    away        it was lost, and is waited for: `why`
    forgotten   it was lost or said goodbye, and nothing is kept for it
    never       its key is known here, and it has not come since the relay began
    at RELAY    it is at another relay; of the way there is nothing known here

The answer is made a few rows in a turn of the loop.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from sern_core.link.link import Link
from sern_core.relay.hub import Hub
from sern_core.vocabulary.names import PEER_SIGN, is_peer
from sern_core.vocabulary.types import ClientName
from sern_relay.admission import Admission
from sern_relay.comings import Coming, Comings
from sern_relay.fleet import relay_of
from sern_relay.refusals import Refusals
from sern_runtime import clock
from sern_runtime.events import wall_text
from sern_runtime.http_routes import JsonParts, closing_array

TOO_LARGE: Final = "the answer is too large"
ELSEWHERE: Final = "at "
"""How the state of a client of another relay begins."""


@dataclass(frozen=True)
class ClientsSource:
    """What the rows are made of. `admission` has the names of the directory, `address(client)` says where a client
    comes from now."""

    relay: str
    hub: Hub
    comings: Comings
    refusals: Refusals
    admission: Admission
    address: Callable[[ClientName], str]

    def names(self) -> list[ClientName]:
        """Everybody who is known."""
        elsewhere = (client for client, _peer in self.hub.peers.at())
        names = {*self.admission.names, *self.hub.links, *self.comings.clients, *elsewhere}
        return sorted(name for name in names if not is_peer(name))


def clients_view(source: ClientsSource) -> JsonParts:
    """The answer. Times by the wall clock are for people; `_s` are how long ago."""
    head = {"name": source.relay, "role": "relay", "time": wall_text(time.time()), "now_s": clock.now()}
    rows = (client_row(source, client) for client in source.names())
    return JsonParts(closing_array({**head, **source.refusals.to_json()}, "clients", rows), TOO_LARGE)


def client_row(source: ClientsSource, client: ClientName) -> dict[str, Any]:
    """One client, as it is now; what is not known is None."""
    now, wall_s = clock.now(), time.time()
    link, coming = source.hub.links.get(client), source.comings.clients.get(client)
    state = _state(link, coming, source.hub.peers.home(client))
    view = None if link is None else link.observe(now=now)
    up = view is not None and view.established
    heard_at_s = link.heard_s if link is not None else coming.heard_s if coming is not None else None
    since_s = None if coming is None else now - coming.since_s
    heard_s = None if heard_at_s is None else now - heard_at_s
    known = source.address(client) or (coming.address if coming is not None else "")
    return {
        "name": client,
        "state": state,
        "relay": None if state in ("never", "forgotten") else relay_of(source.hub, client),
        "why": coming.why if coming is not None and not state.startswith(ELSEWHERE) else "",
        "address": known or None,
        "lane": view.lane if view is not None and up else None,
        "since": None if since_s is None else wall_text(wall_s - since_s),
        "since_s": since_s,
        "heard": None if heard_s is None else wall_text(wall_s - heard_s),
        "heard_s": heard_s,
        "round_trip_s": view.srtt_s or None if view is not None and up else None,
        "loss": view.loss if view is not None and up else None,
        "received_bytes": 0 if link is None else link.heard_bytes,
        "sent_bytes": 0 if view is None else view.wire_bytes,
        "streams": len(source.hub.routing.streams_of(client)),
        "sessions": 0 if coming is None else coming.sessions,
        "takeovers": 0 if coming is None else coming.takeovers,
    }


def _state(link: Link | None, coming: Coming | None, peer: ClientName | None) -> str:
    if link is not None and link.established:
        return "silent" if link.lane.stalled else "connected"
    if peer is not None:
        return ELSEWHERE + peer.removeprefix(PEER_SIGN)
    if coming is None:
        return "never"
    return "away" if link is not None and coming.waited_for else "forgotten"
