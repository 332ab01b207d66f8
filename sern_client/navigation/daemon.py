"""The process of a node that navigates: endpoint, node, action, HTTP and logs."""

import asyncio
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Final

from prometheus_client import CollectorRegistry

from sern_client.action_conversion.endpoint import ActionEndpoint, Rule
from sern_client.endpoints.base import Endpoint, ServiceEndpoint
from sern_client.endpoints.composite import with_services
from sern_client.factory import combined
from sern_client.navigation.action import NavigateToPose, Types
from sern_client.navigation.metrics import register_navigation
from sern_client.navigation.node import NavigationNode
from sern_client.navigation.options import Localisation, Mount, NodeOptions, OnLinkLoss, Stamps, TopicNames
from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.config.endpoints import EndpointSection
from sern_runtime.config.load import Loaded
from sern_runtime.config.navigation import NavigationFile, load_navigation
from sern_runtime.entry import blamed_on, end_tasks, log_warnings, serve
from sern_runtime.http_routes import Health
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.loop import Shutdown
from sern_runtime.metrics import Metrics
from sern_runtime.optional import OptionalParts
from sern_runtime.ros_files import installed_files
from sern_runtime.sdnotify import Notifier, Watchdog

if TYPE_CHECKING:
    from sern_client.navigation.perceiving import Perception
    from sern_runtime.http import HttpServer

NODE_NAME: Final = "sern_navigation"
GOALS_S: Final = 3600.0
"""How long a goal of a ROS 1 node may take."""
TICK_S: Final = 0.5

_log = logging.getLogger(__name__)


async def run_navigation(path: Path, shutdown: Shutdown) -> int:
    """Run until asked to stop. Raises ConfigError for what is wrong with the file or the machine."""
    loaded = load_navigation(path)
    log_warnings(_log, loaded.warnings)
    daemon = NavigationDaemon(loaded)
    try:
        await daemon.start()
        await serve(shutdown, daemon.tasks)
        daemon.notifier.stopping("stopping")
    finally:
        await daemon.stop()
    return 0


class NavigationDaemon:
    """`start` once, `stop` once; `stop` alone is safe at any point."""

    def __init__(self, loaded: Loaded[NavigationFile]) -> None:
        self.loaded = loaded
        self.notifier = Notifier.from_environment()
        self.errors = InternalErrors()
        self.parts = OptionalParts("http", "mapping", "metrics", "perception")
        model = loaded.model
        self.encoding = Encoding.ROS1 if model.endpoints[0].kind == "ros1" else Encoding.CDR
        self.endpoint = self._make_endpoint()
        self.node = NavigationNode(node_options(model), model.grid.grid, self.endpoint, self.encoding)
        self.perception = self._make_perception()
        if self.perception is not None:
            self.node.hears_clouds = self.perception.heard
        self._http: HttpServer | None = None
        self._started = False
        self.tasks: list[asyncio.Task[None]] = []

    def _make_endpoint(self) -> Endpoint:
        model = self.loaded.model
        named = [_named(section) for section in model.endpoints]
        endpoint = combined(named, self.loaded.resolve, as_node=True)
        services = with_services(endpoint)
        if self.encoding is Encoding.CDR or services is None:
            return endpoint
        rule = Rule(compile_pattern(model.topics.action), GOALS_S)
        files = installed_files(map(self.loaded.resolve, model.type_paths))
        return ActionEndpoint(endpoint, services, self.encoding, [rule], namespace="/", files=files)

    def _make_perception(self) -> "Perception | None":
        section = self.loaded.model.perception
        if section is None:
            return None
        from sern_client.navigation.perceiving import Perception, PerceptionOptions
        from sern_perception.projection import ImageShape

        shape = ImageShape(
            section.rings, section.columns, math.radians(section.low_deg), math.radians(section.high_deg)
        )
        model = None if section.model is None else self.loaded.resolve(section.model)
        options = PerceptionOptions(section.labels, section.obstacles, section.rate_hz, shape, model)
        with blamed_on(self.loaded.path, "perception"):
            return Perception(options, self.encoding, self.node.say)

    async def start(self) -> None:
        """ConfigError: the graph cannot be joined, or the action not be served there."""
        self.errors.watch(asyncio.get_running_loop())
        ros_types.load()
        model = self.loaded.model
        if model.http.listen is not None:
            with blamed_on(self.loaded.path, "http", "listen"):
                self._http = self._make_http(model.http.listen)
                await self._http.start()
        self._started = True
        with blamed_on(self.loaded.path, "endpoint"):
            await self.endpoint.start(self.node)
            services = with_services(self.endpoint)
            if services is not None:
                self._serve(services)
        self.tasks.append(asyncio.create_task(self.node.run(), name="navigation"))
        if self.node.makes_map:
            kept = self.parts.keep("mapping", self.node.keep_map, reset=lambda: None)
            self.tasks.append(asyncio.create_task(kept, name="mapping"))
        if self.perception is not None:
            kept = self.parts.keep("perception", self.perception.run, reset=lambda: None)
            self.tasks.append(asyncio.create_task(kept, name="perception"))
        self.tasks.append(asyncio.create_task(self._tick(), name="tick"))
        kinds = " and ".join(section.kind for section in model.endpoints)
        self.notifier.ready(f"navigation at {kinds}")
        _log.info("navigation started at %s: goals by %s and %s", kinds, model.topics.action, model.topics.goal)

    def _serve(self, services: ServiceEndpoint) -> None:
        model = self.loaded.model
        paths = tuple(map(self.loaded.resolve, model.type_paths))
        node = self.node
        action = NavigateToPose(TopicName(model.topics.action), Types.known(paths), go=node.go, cancel=node.cancel)
        action.serve(self.endpoint, services)
        node.action = action

    async def stop(self) -> None:
        await end_tasks(self.tasks)
        await self.node.close()
        if self._started:
            await self.endpoint.stop()
        if self._http is not None:
            await self._http.stop()
        self.notifier.close()

    async def _tick(self) -> None:
        watchdog = Watchdog(self.notifier, {"cycles": lambda: self.node.cycles})
        while True:
            await asyncio.sleep(TICK_S)
            if watchdog.interval_s is not None:
                watchdog.check()
            self.notifier.status(self.node.words()[1])

    def _make_http(self, listen: str) -> "HttpServer":
        from sern_runtime.http import HttpServer

        registry = CollectorRegistry()
        metrics = Metrics(registry)
        register_navigation(metrics, self.node, self.perception)
        self.errors.register(metrics)
        self.parts.register(metrics)
        server = HttpServer(
            listen,
            registry,
            health=lambda: Health(ok=True, reason="running"),
            ready=self.readiness,
            json_routes={"/api/navigation": self.node.to_json},
            access=self.loaded.model.http.access(self.loaded.path.parent),
            parts=self.parts,
        )
        server.register(metrics)
        return server

    def readiness(self) -> Health:
        """What `/readyz` says: whether a goal would be driven to."""
        return self.node.readiness()


def node_options(model: NavigationFile) -> NodeOptions:
    """What the file says."""
    return NodeOptions(
        topics=TopicNames(**model.topics.model_dump()),
        navigator=model.options(),
        mapper=model.mapping.made(),
        lidar=Mount(**model.lidar.model_dump()),
        localisation=Localisation(model.localisation),
        start=model.start,
        stamps=Stamps(model.stamps),
        stamped=model.stamped,
        yaw_scale=model.yaw_scale,
        base_frame=model.base_frame,
        on_link_loss=OnLinkLoss(model.on_link_loss),
        link_timeout_s=model.link_timeout_s,
        seed=model.seed,
    )


def _named(section: EndpointSection) -> EndpointSection:
    """The section with the name of the node, where the file gives none. A node hears what SERN's clients publish."""
    name = {} if "node_name" in section.model_fields_set else {"node_name": NODE_NAME}
    return section.model_copy(update={"accept_bridged": True, **name})
