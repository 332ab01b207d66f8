"""The `unity` endpoint: scenes connect, subscribe to topics of other sites, publish, call services and offer them."""

import asyncio
import logging
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

from sern_client.endpoints.base import (
    Difference,
    Held,
    ServiceEvents,
    ServiceHandler,
    ServiceInfo,
    ServiceServer,
    Sink,
    Subscription,
    TopicEvents,
    Viewed,
)
from sern_client.endpoints.common.published import PublishedTopics
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.common.viewed import NothingOnDemand
from sern_client.endpoints.unity import framing
from sern_client.endpoints.unity.framing import Command, Frame
from sern_client.endpoints.unity.options import UnityOptions
from sern_client.endpoints.unity.scene import Ended, Scene
from sern_client.endpoints.unity.services import Services
from sern_client.endpoints.unity.topics import TopicPublisher, Topics, type_of
from sern_core.topics.patterns import PatternSet
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import topic_name
from sern_core.vocabulary.types import DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.config.base import is_local
from sern_runtime.http import bind_problem, parse_listen
from sern_runtime.ros_files import installed_files

if TYPE_CHECKING:
    from sern_runtime.metrics import Metrics

_SLASH: Final = "/"

_log = logging.getLogger(__name__)


class UnityEndpoint:
    """An `Endpoint`, a `ViewingEndpoint` and a `ServiceEndpoint`."""

    def __init__(self, options: UnityOptions) -> None:
        self.options = options
        self.faults = 0
        """What scenes did wrong."""
        self.ended: Counter[Ended] = Counter()
        self.refused = 0
        """Connections beyond `max_connections`."""
        self.scenes: dict[Scene, asyncio.Task[Any]] = {}
        self.services = Services(options.encoding, installed_files(options.type_paths))
        self._say = SayOnce(_log)
        self._viewed: Viewed = NothingOnDemand()
        self._topics: Topics | None = None
        self._published: PublishedTopics | None = None
        self._server: asyncio.Server | None = None
        self._early: dict[TopicName, TopicInfo] = {}
        self._next: dict[Scene, tuple[Command, int]] = {}  # what the next message of a scene is
        self._lost: Counter[DropReason] = Counter()  # of scenes that have gone

    @property
    def encoding(self) -> Encoding:
        return self.options.encoding

    @property
    def exhausted(self) -> bool:
        return False

    @property
    def port(self) -> int:
        """Where scenes connect, also when port 0 was asked for. Only while started."""
        assert self._server is not None
        return int(self._server.sockets[0].getsockname()[1])

    @property
    def drops(self) -> dict[DropReason, int]:
        """Messages that a slow scene did not get, and those of scenes that did not go on."""
        total = Counter(self._lost)
        for scene in self.scenes:
            total.update(scene.waiting.dropped)
        for part in (self._topics, self._published):
            if part is not None:
                total.update(part.dropped)
        return {reason: count for reason, count in total.items() if count}

    def register_metrics(self, metrics: "Metrics") -> None:
        metrics.gauge("sern_unity_scenes", "Scenes that are connected.", (), lambda: [((), len(self.scenes))])
        metrics.counter(
            "sern_unity_ended_total",
            "Connections of scenes that have ended, by why.",
            ("reason",),
            lambda: [((str(why),), self.ended[why]) for why in Ended],
        )
        metrics.counter(
            "sern_unity_refused_total", "Connections beyond max_connections.", (), lambda: [((), self.refused)]
        )
        metrics.counter("sern_unity_faults_total", "What scenes did wrong.", (), lambda: [((), self.faults)])

    async def start(self, events: TopicEvents) -> None:
        """ConfigError when the port is taken, or open to the network and not meant to be."""
        options = self.options
        patterns = PatternSet([".*"] if options.publish is True else options.publish or ())
        self._published = PublishedTopics("scenes", patterns.fullmatch, events)
        self._topics = Topics(options.encoding, self._viewed, lambda: self.scenes)
        host, port = parse_listen(options.listen)
        if not (options.allow_remote or is_local(f"tcp://{options.listen}")):
            raise ConfigError(f"endpoint unity: {options.listen} is open to the network; set allow_remote for that")
        try:
            self._server = await asyncio.start_server(self._connected, host, port)
        except OSError as error:
            raise ConfigError(f"endpoint unity: cannot listen on {options.listen}: {bind_problem(error)}") from error
        for info in self._early.values():
            self._topics.offered(info)
        self._early.clear()
        _log.info("Unity scenes connect to %s:%d (%s)", host, self.port, options.protocol)

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
        for scene in self.scenes:
            scene.end(Ended.STOPPED)
        await asyncio.gather(*self.scenes.values(), return_exceptions=True)
        await self.services.close()
        if self._topics is not None:
            self._topics.close()
        if self._published is not None:
            self._published.close()
        if self._server is not None:
            await self._server.wait_closed()

    # Topics of other sites

    def use_viewed(self, viewed: Viewed) -> None:
        self._viewed = viewed

    def topic_offered(self, info: TopicInfo) -> None:
        if self._topics is None:
            self._early[info.name] = info
        else:
            self._topics.offered(info)

    def topic_withdrawn(self, name: TopicName) -> None:
        self._early.pop(name, None)
        if self._topics is not None:
            self._topics.withdrawn(name)

    def advertise(self, info: TopicInfo) -> TopicPublisher:
        if self._topics is None:
            raise UsageError("advertise before start")
        if info.encoding is not self.options.encoding:
            raise ConfigError(f"{info.name}: {info.encoding} bodies are no messages of {self.options.protocol}")
        return self._topics.advertise(info)

    # Topics of scenes

    def subscribe(self, name: TopicName, sink: Sink) -> Subscription:
        if self._published is None:
            raise UsageError(f"{name}: no scene publishes such a topic")
        return self._published.subscribe(name, sink)

    def interest(self, name: TopicName, wanted: bool) -> None:
        """Makes no difference: a scene publishes all the same, and the link drops what nobody wants."""

    def validate(self, held: Held) -> list[Difference]:
        here = Held()
        if self._topics is not None and self._published is not None:
            here = Held(Counter(each.name for each in self._topics.publishers), self._published.subscriptions)
        return held.differences(here)

    # Services

    def watch_services(self, events: ServiceEvents) -> None:
        self.services.watch(events)

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        """The type of a service, as `KnowsServiceTypes` has it."""
        return self.services.definition(type_name, encoding)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        return await self.services.call(name, request, timeout_s=timeout_s)

    def serve(self, info: ServiceInfo, handler: ServiceHandler) -> ServiceServer:
        return self.services.serve(info, handler)

    # Connections

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self.scenes) >= self.options.max_connections:
            self.refused += 1
            self._say(f"more than {self.options.max_connections} scenes; others are refused (max_connections)")
            writer.transport.abort()
            return
        scene = Scene(reader, writer, self.options, self, self._fault)
        task = asyncio.current_task()
        assert task is not None
        self.scenes[scene] = task
        _log.info("a scene is connected from %s", scene.address)
        why = Ended.STOPPED
        try:
            why = await scene.run()
        finally:
            del self.scenes[scene]
            self.ended[why] += 1
            self._lost.update(scene.waiting.dropped)
            self._gone(scene)
            _log.info("the scene at %s has gone: %s", scene.address, why)

    def _gone(self, scene: Scene) -> None:
        self._next.pop(scene, None)
        self.services.gone(scene)
        if self._topics is not None and self._published is not None:
            self._topics.gone(scene)
            self._published.end_all(scene)

    def _fault(self, problem: str) -> None:
        self.faults += 1
        self._say(f"a Unity scene: {problem}")

    def frame(self, scene: Scene, frame: Frame) -> None:
        """What a scene says. WireError: the connection cannot be gone on with."""
        coming = self._next.pop(scene, None)
        if frame.destination.startswith(framing.COMMAND):
            try:
                asked = Command(frame.destination)
            except ValueError:
                scene.error(f"{frame.destination[:80]!r} is no command that is known here")
                return
            self._asked(scene, asked, framing.parameters_of(frame.body))
            return
        try:
            name = _named(frame.destination)
        except ConfigError as error:
            scene.error(str(error))
            return
        assert self._published is not None
        if coming is None:
            if not self._published.publish(scene, name, frame.body):
                scene.error(f"{name}: a message without __publish before it; it is dropped")
        elif coming[0] is Command.REQUEST:
            self.services.asked(scene, coming[1], name, frame.destination, frame.body)
        elif not self.services.answered(scene, coming[1], frame.body):
            self._fault(f"{scene.address}: an answer to call {coming[1]} of {name}, for which nobody waits")

    def _asked(self, scene: Scene, asked: Command, said: Any) -> None:
        if asked in (Command.REQUEST, Command.RESPONSE):
            self._next[scene] = asked, framing.number_of(said, "srv_id")
            return
        assert self._topics is not None
        if asked is Command.TOPIC_LIST:
            known = self._topics.known()
            types = [ros_types.ros1_name(type_name) for type_name in known.values()]
            scene.answer(framing.command("topic_list", topics=list(known), types=types))
            return
        spelled = framing.text_of(said, "topic")
        try:
            self._of_a_name(scene, asked, said, _named(spelled), spelled)
        except ConfigError as error:
            scene.error(str(error))

    def _of_a_name(self, scene: Scene, asked: Command, said: Any, name: TopicName, spelled: str) -> None:
        """A command about a topic or a service. ConfigError: it cannot be done."""
        assert self._topics is not None and self._published is not None
        match asked:
            case Command.SUBSCRIBE:
                self._topics.subscribe(scene, name, spelled, _type(said, "msg"))
            case Command.REMOVE_SUBSCRIBER:
                self._topics.unsubscribe(scene, name)
            case Command.PUBLISH:
                self._publishes(scene, name, _type(said, "msg"), latched=said.get("latch") is True)
            case Command.REMOVE_PUBLISHER:
                self._published.end(scene, name)
            case Command.USE_SERVICE:
                self.services.uses(scene, name, _type(said, "srv"))
            case Command.OFFER_SERVICE:
                self.services.offers(scene, name, spelled, _type(said, "srv"))
            case Command.REMOVE_OFFERED_SERVICE:
                self.services.withdrawn(scene, name)
            case Command.REMOVE_USED_SERVICE:
                pass  # nothing is kept of who may call

    def _publishes(self, scene: Scene, name: TopicName, type_name: str, *, latched: bool) -> None:
        assert self._published is not None
        kind = ros_types.resolve(type_name, self._definition(type_name), self.options.encoding)
        info = TopicInfo(
            name, kind.name, kind.encoding, kind.text.type_hash, kind.text.definition, latched=latched, reliable=latched
        )
        self._published.begin(scene, info)

    def _definition(self, type_name: str) -> str:
        """Of a type that is not known to everybody; empty: it is, or to nobody."""
        if ros_types.describe(type_name, self.options.encoding) is not None:
            return ""
        return self.services.message_definition(type_name)


def _named(text: str) -> TopicName:
    """A name as scenes write it, with a slash before it or without. ConfigError: it is none."""
    try:
        return topic_name(text if text.startswith(_SLASH) else _SLASH + text)
    except UsageError as error:
        raise ConfigError(str(error)) from None


def _type(said: Any, kind: str) -> str:
    return type_of(framing.text_of(said, "message_name"), kind)
