"""The metrics of a client: read at scrape from whoever counts."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sern_client.bridge import Bridge
from sern_client.checks import TableCheck
from sern_client.endpoints.base import CountingEndpoint, MeasuredEndpoint
from sern_client.guard import Guard
from sern_client.link_state import LinkState
from sern_client.operating import Operating
from sern_client.relays import Relays
from sern_client.spool.spool_metrics import register_spool
from sern_client.summaries.client_summaries import register_summaries
from sern_runtime.adaptation import Adaptation
from sern_runtime.collector import CollectorWatch
from sern_runtime.durable.durable_metrics import register_durable
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.link_metrics import register_codecs, register_links, register_received
from sern_runtime.metrics import Metrics

if TYPE_CHECKING:
    from sern_client.scene.node import SceneNode


@dataclass(frozen=True, slots=True)
class Counting:
    """The parts of a client that count. None: the client has none."""

    bridge: Bridge
    relays: Relays
    link_state: LinkState
    check: TableCheck
    guard: Guard | None
    adaptation: Adaptation | None
    errors: InternalErrors
    collector: CollectorWatch
    scene: "SceneNode | None" = None
    operating: Operating | None = None


def register_client(metrics: Metrics, parts: Counting) -> None:
    """Have `metrics` read all of them."""
    _register_link(metrics, parts)
    _register_endpoint(metrics, parts)
    _register_commands(metrics, parts)
    _register_messages(metrics, parts)
    _register_operating(metrics, parts.operating)


def _register_link(metrics: Metrics, parts: Counting) -> None:
    bridge = parts.bridge
    core = bridge.core
    register_links(metrics, lambda: [core.link])
    parts.relays.register(metrics)
    parts.relays.connection.datagrams.register(metrics)
    register_received(metrics, core.received, bridge.inbound.ages)
    register_codecs(metrics, core.coder)
    parts.link_state.register(metrics)
    register_durable(metrics, None if bridge.durable is None else bridge.durable.disk)
    register_spool(metrics, bridge.spool)
    parts.errors.register(metrics)
    parts.collector.register(metrics)
    register_summaries(metrics, bridge.outbound.summaries)
    if parts.scene is not None:
        parts.scene.register(metrics)
    metrics.gauge(
        "sern_objects",
        "Cross-reality objects, of this client and of others.",
        ("whose",),
        lambda: [(("own",), float(len(core.objects.registry))), (("others",), float(len(core.mirror.objects)))],
    )
    metrics.counter(
        "sern_object_changes_total",
        "Changes of objects of others that came, by outcome.",
        ("outcome",),
        lambda: [((outcome,), float(count)) for outcome, count in core.mirror.counts.items()],
    )
    metrics.counter(
        "sern_reckoned_poses_total",
        "Poses that were not sent, because the twin of who receives them is right without.",
        read=lambda: [((), float(bridge.outbound.reckoned))],
    )
    metrics.counter(
        "sern_patch_gaps_total",
        "Times a grid of patches could not go on, and waited for the next whole one.",
        read=lambda: [((), float(bridge.inbound.rebuilds.gaps))],
    )


def _register_endpoint(metrics: Metrics, parts: Counting) -> None:
    endpoint, check = parts.bridge.site.endpoint, parts.check

    def dropped() -> list[tuple[tuple[str], float]]:
        drops = endpoint.drops if isinstance(endpoint, CountingEndpoint) else {}
        return [((str(reason),), float(count)) for reason, count in drops.items()]

    metrics.counter(
        "sern_endpoint_dropped_total",
        "Messages that were dropped between this site's nodes and its endpoint.",
        ("reason",),
        dropped,
    )
    if isinstance(endpoint, MeasuredEndpoint):
        endpoint.register_metrics(metrics)
    parts.bridge.site.parts.register(metrics)
    metrics.gauge(
        "sern_endpoint_differences",
        "Differences between what this client holds open at its endpoint and what is open there, at the last look.",
        read=lambda: [((), float(len(check.found)))],
    )
    metrics.counter(
        "sern_endpoint_differences_total",
        "Differences that were ever found there; each is a line in the log.",
        read=lambda: [((), float(check.total))],
    )
    if parts.adaptation is not None:
        parts.adaptation.register(metrics)


def _register_commands(metrics: Metrics, parts: Counting) -> None:
    inbound, guard = parts.bridge.inbound, parts.guard
    metrics.counter(
        "sern_command_lease_expired_total",
        "Times a command topic went quiet and the stop command was published.",
        read=lambda: [((), float(inbound.commands.leases_fired))],
    )
    metrics.counter(
        "sern_command_guard_stops_total",
        "Leases that ran out while the client was held up: its guard published the stop command.",
        read=lambda: [((), float(0 if guard is None else guard.stopped))],
    )
    metrics.counter(
        "sern_command_guard_restarts_total",
        "Times the guard of the command topics had ended and was started again.",
        read=lambda: [((), float(0 if guard is None else guard.restarts))],
    )
    metrics.counter(
        "sern_deadline_missed_total",
        "Gaps between messages longer than the topic's deadline_s.",
        ("topic",),
        lambda: [((topic,), float(count)) for topic, count in inbound.deadlines_missed.items()],
    )


def _register_messages(metrics: Metrics, parts: Counting) -> None:
    bridge = parts.bridge
    site, goals, services = bridge.site, bridge.goals, bridge.services
    metrics.counter(
        "sern_frame_ids_unread_total",
        "Messages whose frame ids stayed without frame_prefix because their type or bytes could not be read.",
        read=lambda: [((), float(site.frames.unreadable))],
    )
    metrics.counter(
        "sern_conversion_failures_total",
        "Messages dropped because they could not be converted between ROS 1 and ROS 2.",
        read=lambda: [((), float(site.converter.failures))],
    )
    metrics.counter(
        "sern_service_calls_total",
        "Calls from here of services of other sites, by outcome: ok, error, timeout, cancelled.",
        ("service", "outcome"),
        lambda: [] if services is None else [(labels, float(count)) for labels, count in services.outcomes.items()],
    )
    metrics.counter(
        "sern_goals_given_up_total",
        "Goals of ROS 1 that were lost on their way, or not heard of for too long; their clients were told.",
        read=lambda: [((), float(0 if goals is None else goals.reported))],
    )
    metrics.counter(
        "sern_publish_failures_total",
        "Messages that arrived and could not be published here.",
        read=lambda: [((), float(bridge.inbound.publish_failures))],
    )
    metrics.counter(
        "sern_bad_frames_total",
        "Frames from the relay that were not valid.",
        read=lambda: [((), float(parts.relays.connection.bad_frames))],
    )


def _register_operating(metrics: Metrics, operating: Operating | None) -> None:
    """What was changed while it runs; a client without this part counts nothing."""
    metrics.gauge(
        "sern_client_reload_failed",
        "1 while what the last reload read is not in force.",
        read=lambda: [((), float(operating is not None and operating.reloads.failing))],
    )
    metrics.counter(
        "sern_client_reload_failures_total",
        "Reloads that kept the old configuration.",
        read=lambda: [((), float(0 if operating is None else operating.reloads.failures))],
    )
    metrics.gauge(
        "sern_client_set_by_hand",
        "Topics of which something is set by hand (sern set).",
        read=lambda: [((), float(0 if operating is None else len(operating.settings.by_topic)))],
    )
    metrics.gauge(
        "sern_e_stop_latched",
        "1 while an e-stop is latched: commands are refused.",
        ("topic",),
        lambda: (
            []
            if operating is None
            else [((t,), float(t in operating.e_stops.latched)) for t in operating.e_stops.topics]
        ),
    )
    metrics.counter(
        "sern_client_local_refused_total",
        "Connections and requests on the local socket that were refused.",
        read=lambda: [((), float(0 if operating is None else operating.refused))],
    )
