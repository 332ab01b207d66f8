"""The metrics of a relay: read at scrape from whoever counts."""

from typing import Protocol

from sern_core.bodies.codecs import Coder
from sern_core.relay.hub import Hub
from sern_relay.durable import DurableHolding
from sern_relay.fabric_metrics import register_relays
from sern_relay.feed import RelayFeed
from sern_relay.hub_news import HubNews
from sern_relay.keyring import RelayKeyring
from sern_relay.readers import Readers
from sern_relay.revocations import FabricRevocations
from sern_relay.server import RelayServer
from sern_relay.transforms import TransformObjects
from sern_relay.transports import Transports
from sern_runtime.adaptation import Adaptation
from sern_runtime.collector import CollectorWatch
from sern_runtime.datagram_watch import DatagramWatch
from sern_runtime.durable.durable_metrics import register_durable
from sern_runtime.fabric.metrics import register_fabric
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.link_metrics import register_codecs, register_links, register_received
from sern_runtime.metrics import Metrics
from sern_runtime.optional import OptionalParts
from sern_runtime.reload_state import ReloadState
from sern_runtime.zap import ZapHandler


class Counting(Protocol):
    """The parts of a relay that count: its daemon. None: not there yet, or not wanted; the feed comes and goes."""

    hub: Hub
    datagrams: DatagramWatch
    coder: Coder
    errors: InternalErrors
    collector: CollectorWatch
    parts: OptionalParts
    adaptation: Adaptation | None
    transports: Transports
    news: HubNews
    zap: ZapHandler | None
    keyring: RelayKeyring | None
    readers: Readers
    reloads: ReloadState
    durable: DurableHolding | None
    revocations: FabricRevocations

    @property
    def takeovers(self) -> int:
        """Sessions that another process took under its client's name."""

    def clients_up(self) -> int:
        """Clients with a session."""


def register_relay(metrics: Metrics, relay: Counting, *, fabric: bool = False) -> None:
    """Have `metrics` read all of them. `fabric`: the relay's file has one."""
    hub = relay.hub
    register_links(metrics, lambda: list(hub.links.values()), hub.clients.given_up.counters)
    relay.datagrams.register(metrics)
    register_received(metrics, hub.received, relay.readers.ages)
    register_codecs(metrics, relay.coder)
    relay.errors.register(metrics)
    register_durable(metrics, None if relay.durable is None else relay.durable.disk)
    relay.collector.register(metrics)
    relay.parts.register(metrics)
    if fabric:
        register_fabric(metrics, lambda: relay.transports.fabric_counters)
        register_relays(metrics, lambda: relay.transports.fabric, relay.revocations, lambda: hub.revocations.left_out)
    if relay.adaptation is not None:
        relay.adaptation.register(metrics)
    metrics.gauge("sern_relay_clients", "Clients with a session.",
                  read=lambda: [((), float(relay.clients_up()))])  # fmt: skip
    metrics.counter("sern_relay_takeovers_total", "Sessions that another process took under its client's name.",
                    read=lambda: [((), float(relay.takeovers))])  # fmt: skip
    metrics.gauge("sern_relay_streams", "Streams announced by clients.",
                  read=lambda: [((), float(len(hub.relayed)))])  # fmt: skip
    metrics.gauge("sern_relay_objects", "Cross-reality objects in the registry.",
                  read=lambda: [((), float(len(hub.objects)))])  # fmt: skip
    metrics.counter("sern_object_changes_total", "Changes of objects that clients sent, by outcome.", ("outcome",),
                    lambda: [((outcome,), float(n)) for outcome, n in hub.exchange.counts.items()])  # fmt: skip
    metrics.gauge("sern_object_feeds", "Clients that subscribe to objects.",
                  read=lambda: [((), float(len(hub.exchange.feeds)))])  # fmt: skip
    metrics.gauge("sern_objects_untold", "Objects that subscribers were not told of: their texts fit into no message.",
                  read=lambda: [((), float(sum(feed.untold for feed in hub.exchange.every_feed())))])  # fmt: skip
    metrics.counter("sern_relay_refusals_total", "Announcements, subscriptions and objects refused, by code.",
                    ("code",), lambda: [((code,), float(n)) for code, n in relay.news.refusals.items()])  # fmt: skip
    metrics.counter("sern_bad_frames_total", "Frames that were not valid; their connections were closed.",
                    read=lambda: [((), float(_bad_frames(relay)))])  # fmt: skip
    metrics.counter("sern_relay_auth_total", "Answers of the ZAP handler.", ("result",),
                    lambda: _auth(relay.zap))  # fmt: skip
    metrics.counter("sern_relay_new_keys_total", "Further keys that clients have offered for themselves.", ("result",),
                    lambda: _new_keys(relay.keyring))  # fmt: skip
    metrics.gauge("sern_relay_connections", "Connections, those without a proven key included.",
                  read=lambda: [((), float(_connections(relay.transports.server)))])  # fmt: skip
    metrics.counter("sern_relay_connections_refused_total", "Connections or messages refused, by reason.",
                    ("reason",), lambda: refused_connections(relay.transports.server))  # fmt: skip
    metrics.counter("sern_relay_replay_evicted_total", "Latched messages let go because of their bounds.",
                    read=lambda: [((), float(hub.streams.replays.evicted))])  # fmt: skip
    metrics.gauge("sern_relay_replay_bytes", "Latched messages kept for late joiners, bytes.",
                  read=lambda: [((), float(hub.streams.replays.held_bytes))])  # fmt: skip
    metrics.counter("sern_relay_transforms_refused_total", "Transforms not taken as objects, by client and reason.",
                    ("client", "code"), lambda: _transforms_refused(relay.readers.transforms))  # fmt: skip
    metrics.counter("sern_feed_messages_total", "Messages of the plain feed, by role and what became of them.",
                    ("role", "result"), lambda: _fed(relay.readers.feed))  # fmt: skip
    metrics.gauge("sern_relay_reload_failed", "1 while what the last reload read is not all in force.",
                  read=lambda: [((), float(relay.reloads.failing))])  # fmt: skip
    metrics.counter("sern_relay_reload_failures_total", "Reloads that kept the old configuration.",
                    read=lambda: [((), float(relay.reloads.failures))])  # fmt: skip


def _bad_frames(relay: Counting) -> int:
    """Those on every lane."""
    return sum(part.bad_frames for part in (relay.transports.server, relay.transports.lanes) if part is not None)


def _connections(server: RelayServer | None) -> int:
    return 0 if server is None else len(server.connections)


def _auth(zap: ZapHandler | None) -> list[tuple[tuple[str, ...], float]]:
    names = ("admitted", "unknown_key", "not_now", "capped", "failed", "malformed")
    return [((name,), float(getattr(zap.counters, name)) if zap else 0.0) for name in names]


def _new_keys(keyring: RelayKeyring | None) -> list[tuple[tuple[str, ...], float]]:
    counts = (0, 0) if keyring is None else (keyring.taken, keyring.refused)
    return [(("taken",), float(counts[0])), (("refused",), float(counts[1]))]


def refused_connections(server: RelayServer | None) -> list[tuple[tuple[str, ...], float]]:
    """Connections and messages that were refused so far, by reason."""
    if server is None:
        return []
    table, socket = server.connections, server.socket
    counts = {
        "capped": table.capped,
        "handshake": table.handshake_failed,
        "accept": table.accept_failed,
        "routing_id": socket.refused_routing_ids,
        "multipart": socket.malformed + server.inflow.endless,
        "revoked": server.revoked,
        "surplus": server.surplus,
        "silent": server.silent,
        "join": server.priority_lanes.refused,
    }
    return [((reason,), float(count)) for reason, count in counts.items()]


def _transforms_refused(transforms: TransformObjects | None) -> list[tuple[tuple[str, ...], float]]:
    refused = transforms.refused if transforms is not None else {}
    return [((client, code), float(n)) for (client, code), n in refused.items()]


def _fed(feed: RelayFeed | None) -> list[tuple[tuple[str, ...], float]]:
    return [] if feed is None else [(labels, float(n)) for labels, n in feed.results()]
