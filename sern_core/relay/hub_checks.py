"""Whether streams, routes and links of the relay's core agree. For tests."""

from collections import Counter, defaultdict
from collections.abc import Container, Mapping, Set

from sern_core.link.link import Link
from sern_core.relay.relayed_streams import RelayedStreams
from sern_core.relay.routing import RoutingTable
from sern_core.vocabulary.types import ClientName


def check_streams(streams: RelayedStreams, routing: RoutingTable, links: Mapping[ClientName, Link]) -> None:
    """A stream has a channel, or a reason for having none, to each of its subscribers. AssertionError."""
    for identity, relayed in streams.by_id.items():
        outs = set(routing.subscribers(identity))
        held = set(relayed.outs) | relayed.unopened | relayed.waiting.keys()
        held |= set(streams.moves.waiting(identity))
        assert not relayed.waiting or streams.fanout.holds(relayed), f"{identity.topic}: some are never told of it"
        assert relayed.unopened.isdisjoint(relayed.waiting), f"{identity.topic}: who waits was told already"
        assert held == outs, f"{identity.topic}: channels {held} but routes {outs}"
        assert not relayed.unopened & set(relayed.outs), f"{identity.topic}: a channel that could not be opened"
        latched = relayed.stream.stream.spec.latched
        assert (relayed.cache is not None) == latched, f"{identity.topic}: its cache does not fit its spec"
        for client, (link, channel) in relayed.outs.items():
            assert links.get(client) is link, f"{identity.topic} goes to a link of {client} that is gone"
            assert link.outgoing.by_stream.get(identity) is channel, f"{identity.topic}: a closed channel to {client}"
    for announcer in streams.fanout.announcers():
        assert announcer in links, f"streams of {announcer}, who is gone, are to be told of"
    known = {info.id for info in routing.infos()}
    assert known == streams.by_id.keys(), f"routes and streams differ: {known ^ streams.by_id.keys()}"


def check_channels(streams: RelayedStreams, links: Mapping[ClientName, Link], others: Set[int]) -> None:
    """No channel is nobody's; `others` are the ids of those that are no stream's. AssertionError."""
    held = {id(pair[1]) for relayed in streams.by_id.values() for pair in relayed.outs.values()}
    held |= streams.fanout.closing() | streams.draining.validate(links) | others
    for client, link in links.items():
        for channel in link.sender.channels.values():
            assert id(channel) in held, f"{channel.stream.id.topic}: nobody's channel to {client}"


def taken(streams: RelayedStreams, local_owners: Container[ClientName]) -> dict[ClientName, Counter[ClientName]]:
    """How many streams each client takes, by who they are of; those of the relay itself are left out."""
    counts: dict[ClientName, Counter[ClientName]] = defaultdict(Counter)
    for identity, relayed in streams.by_id.items():
        for client in relayed.outs if identity.origin not in local_owners else ():
            counts[client][identity.origin] += 1
    return counts
