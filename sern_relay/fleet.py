"""Which relay a client is at, and the topics of clients of other relays that are not relayed here: for /api/topics and
/api/clients. Of other relays it is known what they tell as objects."""

from collections.abc import Iterator

from sern_core.relay.far_objects import topic_of
from sern_core.relay.hub import Hub
from sern_core.vocabulary.names import PEER_SIGN
from sern_core.vocabulary.types import ClientName, Durability
from sern_runtime.topics_view import TopicView, announced_summary


def relay_of(hub: Hub, client: ClientName) -> str:
    """The relay that a client is at, or was at last."""
    peer = hub.peers.home(client)
    return hub.name if peer is None else peer.removeprefix(PEER_SIGN)


def announced(hub: Hub) -> dict[str, TopicView]:
    """Every topic that is relayed here; where there are other relays, `relays` beside its `owners` says at which each
    is."""
    rows = announced_summary(hub.streams.announced())
    for row in rows.values() if hub.peers.names else ():
        row["relays"] = [relay_of(hub, owner) for owner in row["owners"]]
    return rows


def elsewhere(hub: Hub, rows: dict[str, TopicView]) -> Iterator[None]:
    """Put topics at other relays that nobody here takes into `rows`, in the same shape; one object is a step."""
    for item in hub.exchange.peers.far.shown():
        yield
        topic = topic_of(item)
        if topic is None:
            continue
        row = rows.setdefault(
            topic,
            {
                "class": item.attributes.get("class", ""),
                "taken": False,
                "owners": [],
                "latched": item.attributes.get("durability") == Durability.TRANSIENT_LOCAL.value,
                "relays": [],
            },
        )
        row["owners"].append(item.owner)
        row["relays"].append(relay_of(hub, item.owner))
