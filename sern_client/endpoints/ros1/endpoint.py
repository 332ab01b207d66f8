"""A node of a ROS 1 master as an endpoint, in plain asyncio: no ROS installation is needed.

What local nodes publish is announced under their names (below `namespace`, if there is one), with the definition, the
md5sum and the latch that the publisher's own connection header tells. Messages are received only while somebody wants
them. What comes from the far side is published at the master, and subscribers connect to us as to any node.

No loops. A SERN endpoint says in every connection header that it is one. Publishers and services that say so are
never announced, by this or any other SERN endpoint, on this host or another one, whatever their names are: what came
over a link does not go back to it. Where local nodes publish on a topic too, only theirs goes out. `accept_bridged`
lifts that, for a chain of two links through one master.

Simulated time (/clock, use_sim_time) is carried like any topic. Time stamps given to the link are wall time, and ages
are counted on monotonic clocks, so a stopped or fast simulation expires nothing.
"""

import asyncio
import logging
import os
import re
import socket
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address
from itertools import count
from typing import Final

from sern_client.endpoints.base import (
    GUARD_SUFFIX,
    Difference,
    Held,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    Sink,
    TopicEvents,
)
from sern_client.endpoints.ros1.graph import Graph, Registration
from sern_client.endpoints.ros1.master import Master, SystemState
from sern_client.endpoints.ros1.publication import Ended, Handle, Limits, Publication
from sern_client.endpoints.ros1.server import TcprosServer
from sern_client.endpoints.ros1.services import Served, ServiceHost, ServiceWatch
from sern_client.endpoints.ros1.slave import BusLink, SlaveApi
from sern_client.endpoints.ros1.subscription import ReceiveCounters, Source, Subscription, Topic
from sern_client.endpoints.ros1.xmlrpc import CallError, XmlRpcServer, check_host, split_uri
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types

DEFAULT_MASTER_URI: Final = "http://localhost:11311"
DEFAULT_NODE_NAME: Final = "sern"
UNREGISTER_S: Final = 1.0
"""How long `stop` tries to tell the master."""
_NODE: Final = re.compile(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Ros1Options:
    """Which master, who we are there, and the limits. None is the default of the environment, as for any ROS node:
    `master_uri` ROS_MASTER_URI, else http://localhost:11311; `host` (the name or address at which other nodes reach
    us) ROS_HOSTNAME, else ROS_IP, else what this machine has towards the master. `node_name` is sern. With
    `publishes_only` the node takes no topic from its master: another one of the same client does. `as_node`: for SERN
    endpoints it is a node as others are, whose topics are of this site.
    """

    master_uri: str | None = None
    host: str | None = None
    node_name: str | None = None
    namespace: str | None = None
    poll_hz: float = 4.0
    queue_messages: int = 1000
    queue_bytes: int = 64 * 2**20
    max_message_bytes: int = 64 * 2**20
    tcp_nodelay: bool = True
    accept_bridged: bool = False
    publishes_only: bool = False
    as_node: bool = False


class Ros1Endpoint:
    """An `Endpoint` and `ServiceEndpoint` that is a node of one ROS 1 master. Several can be in one process."""

    def __init__(self, options: Ros1Options, *, environ: Mapping[str, str] | None = None) -> None:
        """ConfigError for a master URI, a host or a node name that cannot be one."""
        environ = os.environ if environ is None else environ
        name = options.node_name or DEFAULT_NODE_NAME
        if not _NODE.fullmatch(name):
            raise ConfigError(f"{name!r} is not the name of a ROS node; write it like sern_robot1")
        self.options = options
        self.caller = "/" + name.lstrip("/")
        """Our name at the master."""
        self.master_uri = options.master_uri or environ.get("ROS_MASTER_URI") or DEFAULT_MASTER_URI
        try:
            self._master_host, _ = split_uri(self.master_uri)
        except CallError as error:
            raise ConfigError(f"master_uri: {error}; write it like {DEFAULT_MASTER_URI}") from None
        self.host = options.host or environ.get("ROS_HOSTNAME") or environ.get("ROS_IP") or ""
        if self.host:
            try:
                check_host(self.host)
            except CallError as error:
                raise ConfigError(f"host: {error}; check it, or ROS_HOSTNAME where it is not set") from None
        self.counters = ReceiveCounters()
        self.max_message_bytes = options.max_message_bytes
        self.tcp_nodelay = options.tcp_nodelay
        self.accept_bridged = options.accept_bridged
        self._publishes_only = options.publishes_only
        self.problem: str | None = None
        """Why this node has left the master for good, in one line; None while all is well."""
        self._prefix = "" if options.namespace in (None, "/") else "/" + str(options.namespace).strip("/")
        self._numbers = count(1)
        self._topics: dict[str, Topic] = {}
        self._publications: dict[str, Publication] = {}
        self._limits = Limits(options.queue_messages, options.queue_bytes)
        self._events: TopicEvents | None = None
        self._state = SystemState({}, {}, {})
        self._off = False
        self._tcpros_port = 0
        self._master = Master(self.master_uri, self.caller)
        self._host_of_services = ServiceHost(self.caller, as_node=options.as_node)
        self._graph = Graph(self._master, self, self._graph_changed, poll_s=1 / options.poll_hz)
        self._ended = Ended(self._publications, self._graph.poll_now)
        self._services = ServiceWatch(
            self._master, self._graph, self._local, options.max_message_bytes, accept_bridged=options.accept_bridged
        )
        self._tcpros = TcprosServer(
            self.caller, self._publications, self._host_of_services, max_frame_bytes=options.max_message_bytes
        )
        self._api = XmlRpcServer(SlaveApi(self, self.master_uri).dispatch)

    # Life cycle

    async def start(self, events: TopicEvents) -> None:
        """Opens our two ports; the master may come later. ConfigError when `host` is none of this machine's."""
        self._events = events
        if not self.host:
            self.host = await _host_towards(self._master_host)
        address = _bind_address(self.host)
        try:
            self._tcpros_port = await self._tcpros.start(address)
            port = await self._api.start(address)
        except OSError as error:
            await self.stop()
            raise ConfigError(f"ros1: cannot listen on {address}: {error.strerror}; check `host`") from None
        self._master.caller_api = f"http://{self.host}:{port}/"
        self._graph.start()

    async def stop(self) -> None:
        self._events = None
        self._services.stop()
        for served in list(self._host_of_services.served.values()):
            served.close()
        for topic in self._topics.values():
            topic.close()
        self._topics.clear()
        for publication in list(self._publications.values()):
            self._ended(publication)
        await self._ended.all_gone()
        await self._graph.stop(UNREGISTER_S)
        self._master.close()
        await self._tcpros.stop()
        self._publications.clear()
        await self._api.stop()
        dropped = self.drops
        if dropped:
            _log.warning("%s: messages dropped: %s", self.master_uri,
                         ", ".join(f"{number} {why}" for why, number in sorted(dropped.items())))  # fmt: skip

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages dropped between local nodes and us, either way, by reason."""
        return self.counters.dropped + self._limits.dropped

    @property
    def connected(self) -> bool:
        """The master answered the last time it was asked."""
        return self._graph.connected

    @property
    def waited_for(self) -> int:
        """Topics that we publish whose first messages wait for subscribers."""
        return sum(not publication.first_messages.over for publication in self._publications.values())

    # Endpoint

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        topic = self._topic(name)
        if topic is None or topic.announced is None:
            raise UsageError(f"{name}: no such topic was announced from {self.master_uri}")
        subscription = topic.subscribe(sink, self._graph.poll_now)
        self._graph.poll_now()
        return subscription

    def advertise(self, info: TopicInfo) -> Handle:
        """ConfigError when the topic is outside our namespace, is no ROS 1 topic, or its hash is another type's than
        its definition's or than that of another stream of the same name; or when this node has left the master."""
        if self.problem is not None:
            raise ConfigError(f"{info.name}: {self.problem}")
        info = self._complete(info)
        name = self._at_master(info.name)
        publication = self._publications.get(name)
        if publication is not None and not (publication.handles or publication.goes_on_as(info)):
            self._ended(publication)
            publication = None
        if publication is None:
            publication = self._publications[name] = Publication(
                name, info, self.caller, self._limits, self._ended, as_node=self.options.as_node
            )
            handle = Handle(publication)  # first: a publication without one ends as soon as nobody is waited for
            self._tell_subscribers(publication)
            # A subscriber whose connection ended comes back only when the master tells it of a publisher; of a topic
            # that ended and begins again before the master has heard of it, it would not.
            self._graph.again(Registration("publisher", name))
            return handle
        if not publication.fits(info):
            raise ConfigError(
                f"{info.name}: {info.type_name} with md5sum {info.type_hash} is not what is published here already, "
                f"{publication.info.type_name} with {publication.info.type_hash}"
            )
        return Handle(publication)

    def interest(self, name: TopicName, wanted: bool) -> None:
        topic = self._topic(name)
        if topic is not None:
            topic.interest(wanted)

    def validate(self, held: Held) -> list[Difference]:
        """Publishers that the master does not list differ too, unless there is no master; and nodes that nobody watches
        any more, so that nothing of theirs would come or go."""
        here = Held()
        for name, publication in self._publications.items():
            if not publication.closed:
                here.publishers[TopicName(self._local(name))] += len(publication.handles)
        for topic in self._topics.values():
            here.subscriptions[TopicName(topic.local)] += len(topic.sinks)
        found = held.differences(Held(+here.publishers, +here.subscriptions))
        found += [
            Difference(TopicName(self._local(name)), f"{self.caller} is not listed as its {kind} at {self.master_uri}")
            for kind, name in self._graph.unlisted
            if kind != "service"
        ]
        found += [
            Difference(TopicName(""), f"{node.name} at {self.master_uri} is not watched any more")
            for node in self._graph.nodes.values()
            if node.ended
        ]
        return found if self.problem is None else [Difference(TopicName(""), self.problem), *found]

    @property
    def encoding(self) -> Encoding:
        """A ROS 1 node publishes ROS 1 messages only."""
        return Encoding.ROS1

    @property
    def exhausted(self) -> bool:
        """Never: a robot goes on."""
        return False

    # ServiceEndpoint

    def watch_services(self, events: ServiceEvents) -> None:
        self._services.watch(events)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        return await self._services.call(self._at_master(name), request, timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> Served:
        """ConfigError also when a local node serves that name: it is not taken away from it."""
        name = self._at_master(info.name)
        nodes = self._state.services.get(name, ())
        if nodes and nodes[0] != self.caller:
            raise ConfigError(f"{info.name}: is served by {nodes[0]} here; not taken over")
        served = self._host_of_services.serve(name, info, handler)
        self._graph.poll_now()
        return served

    # Names: ours are below the namespace, the master's are not

    def _local(self, name: str) -> str:
        return self._prefix + name

    def _topic(self, name: TopicName) -> Topic | None:
        """The topic that is announced under a name, or will be."""
        return self._topics.get(name[len(self._prefix) :]) if name.startswith(self._prefix + "/") else None

    def _at_master(self, name: TopicName) -> str:
        if not name.startswith(self._prefix + "/"):
            raise ConfigError(f"{name} is outside {self._prefix}, the namespace of the master at {self.master_uri}")
        return name[len(self._prefix) :]

    def _complete(self, info: TopicInfo) -> TopicInfo:
        """Canonical, with definition and hash filled in where missing, and checked where both came."""
        if info.encoding is not Encoding.ROS1:
            raise ConfigError(f"{info.name}: {info.encoding} messages cannot be published by a ROS 1 node")
        type_name = ros_types.canonical(info.type_name)
        definition, md5 = info.definition, info.type_hash
        if definition:
            computed = ros_types.hash_of(type_name, definition, Encoding.ROS1)
            if md5 and md5 != computed:
                raise ConfigError(
                    f"{info.name}: {type_name} came with md5sum {md5}, but its definition has {computed}; "
                    "both sides need the same version of the type"
                )
            md5 = computed
        elif (known := ros_types.describe(type_name, Encoding.ROS1)) is not None and md5 in ("", known.type_hash):
            definition, md5 = known
        if not md5:
            raise ConfigError(f"{info.name}: the md5sum of {type_name} is not known; subscribers could not check it")
        return TopicInfo(info.name, type_name, Encoding.ROS1, md5, definition, info.latched, info.reliable)

    # What the graph asks and tells

    def desired(self) -> dict[Registration, str]:
        if self._off:
            return {}
        publications = [*self._ended.leaving, *self._publications.values()]
        return (
            {Registration("publisher", publication.topic): publication.type_name for publication in publications}
            | {Registration("subscriber", topic.topic): "" for topic in self._topics.values() if topic.sinks}
            | dict.fromkeys((Registration("service", name) for name in self._host_of_services.served), "")
        )

    async def register(self, registration: Registration, detail: str) -> None:
        kind, name = registration
        if kind == "service":
            await self._master.register_service(name, self._service_uri)
        elif kind == "publisher":
            await self._master.register_publisher(name, detail)
        elif kind == "subscriber" and (topic := self._topics.get(name)) is not None:
            await self._master.register_subscriber(name, _type_of(topic))

    async def unregister(self, registration: Registration) -> None:
        kind, name = registration
        if kind == "service":
            await self._master.unregister_service(name, self._service_uri)
        elif kind == "publisher":
            self._tcpros.returning.ended(name)
            await self._master.unregister_publisher(name)
        else:
            await self._master.unregister_subscriber(name)

    @property
    def _service_uri(self) -> str:
        return f"rosrpc://{self.host}:{self._tcpros_port}"

    def _graph_changed(self, state: SystemState) -> None:
        if self._off or self._events is None:
            return
        self._state = state
        for name, nodes in () if self._publishes_only else state.publishers.items():
            others = [node for node in nodes if node not in (self.caller, self.caller + GUARD_SUFFIX)]
            topic = self._topics.get(name)
            if topic is None and others and name_problem(self._local(name)) is None:
                topic = self._topics[name] = Topic(name, self._local(name), self)
            if topic is not None:
                self._set_sources(topic, others)
        for name in list(self._topics):
            if name not in state.publishers:
                self._set_sources(self._topics[name], [])
            if not self._topics[name].sources:
                self._topics.pop(name).close()
        for publication in list(self._publications.values()):
            self._tell_subscribers(publication)
        if not self._publishes_only:
            self._services.update(state.services)

    def _tell_subscribers(self, publication: Publication) -> None:
        """Tell a publication its subscribers, once the master lists us: they connect now, or have."""
        name = publication.topic
        if self.caller in self._state.publishers.get(name, ()):
            publication.registered(set(self._state.subscribers.get(name, ())) - {self.caller})

    def _set_sources(self, topic: Topic, nodes: list[str]) -> None:
        for node in [node for node in topic.sources if node not in nodes]:
            self._graph.detach(node, topic.sources.pop(node))
        for node in nodes:
            if node not in topic.sources:
                source = topic.sources[node] = Source(topic, node)
                self._graph.attach(node, source)

    # What topics ask and tell

    def next_number(self) -> int:
        return next(self._numbers)

    def announce(self, topic: Topic, info: TopicInfo) -> None:
        if self._events is not None:
            self._events.topic_added(info)

    def withdraw(self, topic: Topic) -> None:
        if self._events is not None:
            self._events.topic_removed(TopicName(topic.local))

    # What the node API asks and tells

    def bus_links(self) -> list[BusLink]:
        links = [
            BusLink(source.number, source.uri, "i", topic.topic, 0, source.link.received_bytes,
                    source.link.received_messages, 0)
            for topic in self._topics.values()
            for source in topic.sources.values()
            if source.link is not None and source.link.open
        ]  # fmt: skip
        links += [
            BusLink(feed.number, feed.caller, "o", publication.topic, feed.sent_bytes, 0, feed.sent_messages,
                    feed.dropped)
            for publication in self._publications.values()
            for feed in publication.feeds
        ]  # fmt: skip
        return links

    def subscribed(self) -> list[tuple[str, str]]:
        return [(topic.topic, _type_of(topic)) for topic in self._topics.values() if topic.sinks]

    def published(self) -> list[tuple[str, str]]:
        return [(publication.topic, publication.type_name) for publication in self._publications.values()]

    def tcpros_address(self) -> tuple[str, int]:
        return self.host, self._tcpros_port

    def asks_for(self, topic: str, caller: str) -> None:
        self._tcpros.returning.asked(topic, caller)

    def publishers_changed(self, topic: str, uris: list[str]) -> None:
        """The master tells its subscribers at once. What it says is asked again, because anybody can call this."""
        known = self._topics.get(topic)
        if known is not None:
            at = {source.uri for source in known.sources.values()} | {self._master.caller_api}
            if not at.issuperset(uris):
                for source in known.sources.values():
                    if (node := self._graph.nodes.get(source.node_name)) is not None and source.uri not in uris:
                        node.look_again()
        self._graph.poll_now()

    def told_to_shut_down(self, why: str) -> None:
        """`rosnode kill`, or the master, because another node took our name: leave it alone until the next start."""
        if self._off:
            return
        self._off = True
        self.problem = f"{self.caller} was told to shut down ({why or 'no reason given'})"
        _log.error("%s: %s; this endpoint does nothing more until the client is started again",
                   self.master_uri, self.problem)  # fmt: skip
        for topic in list(self._topics.values()):
            self._set_sources(topic, [])
        self._topics.clear()
        self._services.update({})
        for publication in list(self._publications.values()):
            self._ended(publication)


def _type_of(topic: Topic) -> str:
    return "*" if topic.announced is None else ros_types.ros1_name(topic.announced.type_name)


def _bind_address(host: str) -> str:
    """Loopback when that is where we are reached, else every address; as ROS nodes do."""
    if host == "localhost":
        return "127.0.0.1"
    with suppress(ValueError):
        if ip_address(host).is_loopback:
            return host
    return "0.0.0.0"


async def _host_towards(master_host: str) -> str:
    """The address from which this machine reaches the master; on the master's own machine its name, if that can be
    resolved, because nodes elsewhere need it."""
    loop = asyncio.get_running_loop()
    with suppress(OSError):
        found = await loop.getaddrinfo(master_host, 11311, family=socket.AF_INET, type=socket.SOCK_DGRAM)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(found[0][4])  # sends nothing: it only makes the kernel choose a route
            address = str(probe.getsockname()[0])
        if not ip_address(address).is_loopback:
            return address
    with suppress(OSError):
        name = socket.gethostname()
        resolved = await loop.getaddrinfo(name, None, family=socket.AF_INET)
        if name != "localhost" and not ip_address(resolved[0][4][0]).is_loopback:
            return name
    return "127.0.0.1"
