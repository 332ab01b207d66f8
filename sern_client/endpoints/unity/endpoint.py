"""Scenes of Unity as an endpoint: a TCP server that scenes with Unity's ROS-TCP-Connector connect to.

What a scene subscribes to is wanted from other sites, and nothing else comes. What it publishes goes out as any other
topic of this site, where `publish` names it. Scenes do not hear each other here. The protocol has neither keys nor
encryption, so the server is for this machine.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Mapping
from typing import Final

from sern_client.endpoints.base import (
    Difference,
    Held,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    Sink,
    TopicEvents,
    Viewed,
)
from sern_client.endpoints.common.interest import OnDemand
from sern_client.endpoints.unity import commands, names
from sern_client.endpoints.unity.commands import Command, shown
from sern_client.endpoints.unity.far_services import FarServices, Served
from sern_client.endpoints.unity.faults import Fault, Faults
from sern_client.endpoints.unity.incoming import Incoming, SceneStream
from sern_client.endpoints.unity.options import UnityOptions
from sern_client.endpoints.unity.outbox import Outbox
from sern_client.endpoints.unity.own_services import OwnServices
from sern_client.endpoints.unity.publications import Publications
from sern_client.endpoints.unity.scene import READ_BYTES, Scene, SceneLimits
from sern_client.endpoints.unity.types import SceneTypes
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime.metrics import Metrics

GOODBYE_S: Final = 1.0
"""How long a scene that is one too many may take to read why."""

_log = logging.getLogger(__name__)


class UnityEndpoint:
    """An `Endpoint`, `ViewingEndpoint`, `ServiceEndpoint`, `CountingEndpoint` and `MeasuredEndpoint`."""

    def __init__(self, options: UnityOptions) -> None:
        self.options = options
        self.faults = Faults(_log)
        self._encoding = Encoding.ROS1 if options.protocol == "ros1" else Encoding.CDR
        self._limits = SceneLimits(options.max_message_bytes, options.queue_bytes, options.stalled_s)
        self._drops: Counter[DropReason] = Counter()
        self.types = SceneTypes(self._encoding, options.type_paths)
        self.incoming = Incoming(self._encoding, self.faults, self._drops, self.types.knows_message)
        self.publications = Publications(options.publish, self.types, self.faults, self._drops)
        self.far_services = FarServices(self.types, self.faults, self._drops)
        self.own_services = OwnServices(self.types, self.faults, self._drops)
        self.scenes: set[Scene] = set()
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.Task[None], Scene] = {}  # also those that are being sent away
        self._stopping = False

    # --- Endpoint ---------------------------------------------------------------------------------------------------

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when the address is another's, or none of this machine's."""
        self.publications.start(events)
        if self.options.second:
            return
        host, port = self.options.place
        try:
            self._server = await asyncio.start_server(self._connected, host, port, limit=READ_BYTES)
        except OSError as error:
            raise ConfigError(
                f"unity: cannot listen on {self.options.listen} ({error.strerror}); end what listens there (another "
                "client, a ROS-TCP-Endpoint), or give `listen` another port"
            ) from None
        _log.info("scenes of Unity connect to %s (%s)", self.options.listen, self.options.protocol)

    async def stop(self) -> None:
        self._stopping = True
        self.publications.close()
        if self._server is not None:
            self._server.close()
        for scene in self._connections.values():
            scene.close()
        await asyncio.gather(*self._connections, return_exceptions=True)
        if self._server is not None:
            await self._server.wait_closed()
        await self.far_services.stop()
        self.incoming.close()

    def subscribe(self, name: TopicName, sink: Sink) -> OnDemand:
        return self.publications.subscribe(name, sink)

    def advertise(self, info: TopicInfo) -> SceneStream:
        return self.incoming.advertise(info)

    def interest(self, name: TopicName, wanted: bool) -> None:
        """A scene cannot be told; what nobody wants is left here."""
        self.publications.subscriptions.interest(name, wanted)

    def validate(self, held: Held) -> list[Difference]:
        found = held.differences(Held(self.incoming.publishers, self.publications.subscriptions.names))
        if self._server is not None and not self._server.is_serving():
            found.append(Difference(TopicName(""), f"nothing listens on {self.options.listen}"))
        return found

    @property
    def encoding(self) -> Encoding:
        """A scene is compiled for one of the two."""
        return self._encoding

    @property
    def exhausted(self) -> bool:
        return False

    # --- ViewingEndpoint, CountingEndpoint, MeasuredEndpoint --------------------------------------------------------

    def use_viewed(self, viewed: Viewed) -> None:
        self.incoming.viewed = viewed

    def topic_offered(self, info: TopicInfo) -> None:
        self.incoming.offered(info)

    def topic_withdrawn(self, name: TopicName) -> None:
        self.incoming.withdrawn(name)

    @property
    def drops(self) -> Mapping[DropReason, int]:
        return self._drops

    def register_metrics(self, metrics: Metrics) -> None:
        metrics.gauge("sern_unity_scenes", "Scenes that are connected.", (), lambda: [((), float(len(self.scenes)))])
        metrics.gauge(
            "sern_unity_waiting_bytes", "Bytes that wait for scenes.", (),
            lambda: [((), float(sum(scene.kept_bytes for scene in self.scenes)))],
        )  # fmt: skip
        metrics.counter(
            "sern_unity_faults_total",
            "What was wrong with what scenes said or asked for, by what it was.",
            ("fault",),
            lambda: [((fault,), float(count)) for fault, count in self.faults.counts.items()],
            known=lambda: [(fault,) for fault in Fault],
        )

    # --- ServiceEndpoint, KnowsServiceTypes -------------------------------------------------------------------------

    def watch_services(self, events: ServiceEvents) -> None:
        self.own_services.watch(events)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        return await self.own_services.call(name, request, timeout_s=timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> Served:
        return self.far_services.serve(info, handler)

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        return self.types.service_definition(type_name, encoding)

    # --- scenes -----------------------------------------------------------------------------------------------------

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._stopping or len(self._connections) >= 2 * self.options.max_connections:
            writer.transport.abort()  # not even those that are sent away are any number
            return
        outbox = Outbox(self.options.queue_bytes, self._drops)
        scene = Scene(reader, writer, self, outbox, self.faults, self._limits)
        task = asyncio.current_task()
        assert task is not None
        self._connections[task] = scene
        task.add_done_callback(self._connections.pop)
        if len(self.scenes) >= self.options.max_connections:
            await self._send_away(scene)
            return
        self.scenes.add(scene)
        _log.info("the scene %s is connected", scene.peer)
        try:
            await scene.run(self._encoding)
        finally:
            self.scenes.discard(scene)
            self._gone(scene)
            _log.info("the scene %s has gone", scene.peer)

    async def _send_away(self, scene: Scene) -> None:
        text = f"{self.options.max_connections} scenes are connected already (max_connections)"
        self.faults(Fault.TOO_MANY, f"{text}; another one is sent away", scene)
        await scene.refuse(self._encoding, GOODBYE_S)

    def _gone(self, scene: Scene) -> None:
        self.incoming.gone(scene)
        self.publications.gone(scene)
        self.far_services.gone(scene)
        self.own_services.gone(scene)

    # --- SceneHandler -----------------------------------------------------------------------------------------------

    def command(self, scene: Scene, command: Command) -> None:
        match command.kind:
            case commands.SUBSCRIBE:
                self.incoming.subscribe(scene, command)
            case commands.REMOVE_SUBSCRIBER:
                self.incoming.unsubscribe(scene, command.topic)
            case commands.PUBLISH:
                self.publications.publish(scene, command)
            case commands.REMOVE_PUBLISHER:
                self.publications.remove(scene, command.topic)
            case commands.ROS_SERVICE:
                self.far_services.register(scene, command)
            case commands.REMOVE_ROS_SERVICE:
                self.far_services.remove(scene, command.topic)
            case commands.UNITY_SERVICE:
                self.own_services.offer(scene, command)
            case commands.REMOVE_UNITY_SERVICE:
                self.own_services.remove(scene, command.topic)
            case commands.REQUEST:
                self.far_services.asks(scene, command.srv_id)
            case commands.RESPONSE:
                self.own_services.answers(scene, command.srv_id)
            case commands.TOPIC_LIST:
                self._list(scene)

    def message(self, scene: Scene, spelling: str, body: bytes) -> None:
        """A topic and a service may have one name: what was announced comes first."""
        if self.far_services.expects(scene, spelling):
            self.far_services.request(scene, spelling, body)
        elif self.own_services.expects(scene, spelling):
            self.own_services.response(scene, spelling, body)
        elif self.publications.publishes(scene, spelling):
            self.publications.message(scene, spelling, body)
        elif self.own_services.serves(scene, spelling):
            self.own_services.response(scene, spelling, body)
        elif self.far_services.expects(scene):
            self.far_services.request(scene, spelling, body)
        else:
            self._drops[DropReason.FORBIDDEN] += 1
            text = f"messages of {shown(spelling)} are dropped: the scene has not registered it, or may not publish it"
            self.faults(Fault.NOT_REGISTERED, text, scene)

    def too_large(self, scene: Scene, spelling: str, nbytes: int) -> None:
        self._drops[DropReason.TOO_LARGE] += 1
        limit = f"max_message_bytes is {self.options.max_message_bytes}"
        self.faults(Fault.TOO_LARGE, f"{shown(spelling)}: a message above {limit} is dropped", scene)
        _log.debug("%s: %s has %d bytes", scene.peer, shown(spelling), nbytes)

    def _list(self, scene: Scene) -> None:
        there = dict(self.publications) | dict(self.incoming)
        topics = sorted(there)
        scene.outbox.answer_list(commands.topic_list(topics, [names.their_type(there[topic]) for topic in topics]))
        scene.wake()
