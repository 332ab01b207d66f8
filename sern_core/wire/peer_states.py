"""What a `peers` message says of each client in it. Pure."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing

MAX_FOR_S: Final = 1e9
MAX_RTT_S: Final = 1e6


class PeerState(NamedTuple):
    """`up`: it has a session and answers, or not, and that for `for_s` seconds; `lane` and `rtt_s` are those between it
    and its relay, as far as known, and `moved`: it has gone to another relay and said so. `up` None: whoever is told
    takes nothing of it any more; `here` says whether it has a session (None: the relay does not say)."""

    name: ClientName
    up: bool | None
    here: bool | None = None
    for_s: float = 0.0
    rtt_s: float | None = None
    lane: str = ""
    moved: bool = False


def peer_states(envelope: framing.Envelope) -> Iterator[PeerState]:
    """Raises WireError for what no honest relay sends."""
    items = envelope.get("peers", [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise WireError("envelope key 'peers' must be a list of maps")
    for item in items:
        name = ClientName(framing.take_str(item, "name", max_length=64))
        if "up" not in item:
            yield PeerState(name, None, framing.take_bool(item, "here") if "here" in item else None)
            continue
        yield PeerState(
            name,
            framing.take_bool(item, "up"),
            for_s=framing.take_float(item, "for", low=0.0, high=MAX_FOR_S) or 0.0,
            rtt_s=framing.take_float(item, "rtt", low=0.0, high=MAX_RTT_S),
            lane=framing.take_str(item, "lane", max_length=16, default=""),
            moved=framing.take_bool(item, "moved"),
        )
