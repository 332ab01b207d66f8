"""The file of a client daemon (`sern-client`): who it is, its relay, its endpoints, and what to do with which topic."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Self

from pydantic import Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator

from sern_core.site.object_mirror import Selection
from sern_core.site.services import ServiceRule, subscriptions
from sern_core.topics.patterns import MAX_CLIENT_PROGRAM, PatternError, PatternSet, compile_pattern
from sern_core.topics.rules import (
    Direction,
    Discovery,
    DiscoveryMode,
    RuleError,
    RuleSet,
    TopicRule,
)
from sern_core.vocabulary.names import normal_namespace
from sern_core.vocabulary.types import ClientName, ObjectKind, PriorityClass, Reliability
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.config.base import (
    ClientText,
    ConnectEndpoint,
    FileModel,
    FileProblem,
    FramePrefix,
    NamespaceText,
    PathText,
    Pattern,
    Section,
    fault,
    is_local,
    lifespan_problem,
    pattern_problem,
    pattern_problems,
    place,
    socket_problems,
)
from sern_runtime.config.endpoints import EndpointSection, RclpyEndpoint
from sern_runtime.config.link_state import LinkStateSection
from sern_runtime.config.load import Loaded, load
from sern_runtime.config.objects import MAX_SELECTIONS, TOPIC_KINDS, ObjectSelection
from sern_runtime.config.scene import SceneSection
from sern_runtime.config.shared import (
    ClassWord,
    DurableSection,
    HttpSection,
    LinkSection,
    LocalSection,
    LogSection,
    SchedulerSection,
    output_problems,
    public_key_problems,
    secret_key_problems,
)
from sern_runtime.config.spool import SpoolSection
from sern_runtime.config.summaries import one_or_list
from sern_runtime.config.topics import TopicSection
from sern_runtime.config.twin import TwinEndpoint
from sern_runtime.config.yaml import Data, Loc

MAX_RELAYS: Final = 8
"""Relays that a client goes to: it may take this many times `failover.failover_s` until it has tried them all."""


class ClientSection(Section):
    """Who this client is."""

    name: ClientText
    """Its name: the one its key has at the relay, and the default namespace of its topics."""
    namespace: NamespaceText | None = None
    """Put before the names of its topics for everyone else: /odom of jackal1 is /jackal1/odom. null: the client's
    name; "/": names are global as they are."""
    frame_prefix: FramePrefix | None = None
    """Put before the frame ids (`frame_id` of headers, `child_frame_id`) in messages that leave this site, and taken
    off those that come in, such as "jackal1/". Ids that are empty or begin with it stay; null: all stay."""

    @property
    def normal_namespace(self) -> str:
        """`/` or `/part`: what `sern_core.topics.rules.to_global` takes."""
        return normal_namespace(self.namespace or self.name)


class RelayConnection(Section):
    """The relay this client connects to, and the keys for it."""

    endpoint: ConnectEndpoint
    """tcp://host:port, or ipc://path on the same machine; a relative path starts at this file."""
    server_key_file: PathText | None = None
    """The relay's public key file (.pub): the client talks to nobody else."""
    secret_key_file: PathText | None = None
    """This client's secret key file (.key)."""
    udp: bool = True
    """Use the datagram lane when the relay offers it and it gets through: a lost packet then delays nothing else."""
    priority_connections: bool = True
    """Where data goes over TCP, give class control two connections of its own: a command or pose then waits neither
    behind bulk bytes nor for the retransmission of one, and goes over both while TCP loses packets (see
    `link.redundancy`)."""
    insecure: bool = False
    """No keys and no encryption; only for ipc and loopback, for trials on one machine."""
    handshake_interval_s: Annotated[float, Field(ge=1, le=120)] = 10.0
    """Time to prove the keys on a new connection, before another is tried. It takes 4 round trips, and some kB of a
    very slow link. The relay waits as long as its own file says: to wait longer, set both."""

    @model_validator(mode="after")
    def _keys(self) -> "RelayConnection":
        if self.insecure:
            if not is_local(self.endpoint):
                raise fault("is accepted only for ipc:// and loopback endpoints; use keys (sern keygen)", "insecure")
            for key in ("server_key_file", "secret_key_file"):
                if getattr(self, key) is not None:
                    raise fault("has no use with insecure: true; remove one of the two", key)
            return self
        for key in ("server_key_file", "secret_key_file"):
            if getattr(self, key) is None:
                raise fault("is missing; make keys with sern keygen (insecure: true only on one machine)", key)
        return self

    def placed(self, base_dir: Path) -> Self:
        """The same with its socket (ipc://) where it is."""
        return self.model_copy(update={"endpoint": place(base_dir, self.endpoint)})

    def file_problems(self, base_dir: Path, loc: Loc, client: ClientName) -> Iterator[FileProblem]:
        """Problems with its socket and its key files; `loc` is its place, `client` whose keys it has."""
        yield from socket_problems(base_dir, self.endpoint, (*loc, "endpoint"))
        if self.server_key_file is not None:
            yield from public_key_problems(base_dir, self.server_key_file, (*loc, "server_key_file"), client=client)
        if self.secret_key_file is not None:
            yield from secret_key_problems(base_dir, self.secret_key_file, (*loc, "secret_key_file"), owner=client)


class FailoverSection(Section):
    """When a client with several relays goes from one to another."""

    failover_s: Annotated[float, Field(ge=0.5, le=3600)] = 2.0
    """A relay that has not answered for so long, on whatever lane, is left for the next one in the list; so is one to
    which no connection comes about within that time. Leave more than three round trips, and more than the outages that
    the link itself is known for: the other relays cannot be reached in those either."""
    return_s: Annotated[float, Field(ge=1, le=604_800)] = 300.0
    """A relay that stands before the one that the client is at is gone back to once it has answered for so long without
    interruption."""


class DiscoverySection(Section):
    """Which topics of the endpoints are offered to the link."""

    mode: DiscoveryMode = DiscoveryMode.MANUAL
    """`manual`: only topics that a rule in `topics` matches; `dynamic`: also all others, as they appear."""
    allow: tuple[Pattern, ...] = (".*",)
    """Only topics (local names) that one of these patterns matches."""
    deny: tuple[Pattern, ...] = ()
    """No topic (local name) that one of these patterns matches; wins over everything else."""
    allow_types: tuple[Pattern, ...] = (".*",)
    """Only topics whose whole message type one of these patterns matches, such as sensor_msgs/.*."""
    deny_types: tuple[Pattern, ...] = ()
    """No topic whose message type one of these patterns matches; wins over everything else."""

    def filter(self) -> Discovery:
        return Discovery(
            mode=self.mode,
            allow=tuple(compile_pattern(text) for text in self.allow),
            deny=tuple(compile_pattern(text) for text in self.deny),
            allow_types=tuple(compile_pattern(text) for text in self.allow_types),
            deny_types=tuple(compile_pattern(text) for text in self.deny_types),
        )


SERVICE_TIMEOUT_S: Final = 5.0
ACTION_STATE: Final = "(?:_action/)?(?:status|feedback)"
"""The topics below an action's name on which its server says how it goes, in ROS 1 and ROS 2."""


class ServiceSection(Section):
    """Services that one rule is about."""

    match: Pattern
    """Regular expression for the whole service name: the local name in `offer`, the global name in `use`."""
    timeout_s: Annotated[float, Field(gt=0, le=3600)] = SERVICE_TIMEOUT_S
    """An answer that takes longer is an error for the caller, and a call that waited longer is not executed."""
    priority: Annotated[ClassWord, Field(alias="class")] = "state"
    """Urgency of the calls (`use`) or answers (`offer`): `control`, `state`, `bulk`."""

    @model_validator(mode="after")
    def _simple(self) -> "ServiceSection":
        try:
            compile_pattern(f"(?:{self.match})/_call/[a-z0-9_]+")
        except PatternError as error:
            raise fault(str(error), "match") from error
        return self

    def rule(self) -> ServiceRule:
        """The rule as the core reads it."""
        return ServiceRule(compile_pattern(self.match), self.timeout_s, PriorityClass[self.priority.upper()])


class ServicesSection(Section):
    """Services across the link. The first rule that matches holds; a service without a rule stays at home."""

    offer: tuple[ServiceSection, ...] = ()
    """Services of this site that others may call (who may is a matter of the relay's access rules)."""
    use: tuple[ServiceSection, ...] = ()
    """Services of other sites to serve here, under their global name (our own namespace is left out)."""


class ActionSection(Section):
    """Actions that one rule is about: a rule for each of their topics and services."""

    match: Pattern
    """Regular expression for the whole action name: the local name in `offer`, the global name in `use`."""
    timeout_s: Annotated[float, Field(gt=0, le=86_400)] = 600.0
    """How long a goal may take: asking for its result (ROS 2) fails after it. A goal or its cancelling is dropped when
    it waits for the link longer than this and 5 s; cancelling in ROS 1 waits for `link.retention_s`."""

    @model_validator(mode="after")
    def _simple(self) -> "ActionSection":
        try:
            compile_pattern(self.under("_action/get_result/_call/[a-z0-9_]+"))
        except PatternError as error:
            raise fault(str(error), "match") from error
        return self

    def under(self, pattern: str) -> str:
        """The pattern of names below the action's."""
        return f"(?:{self.match})/{pattern}"

    def service_rules(self) -> tuple[ServiceRule, ...]:
        """ROS 2: three services."""
        ask = compile_pattern(self.under("_action/(?:send_goal|cancel_goal)"))
        return (
            ServiceRule(ask, min(self.timeout_s, SERVICE_TIMEOUT_S), PriorityClass.CONTROL),
            ServiceRule(compile_pattern(self.under("_action/get_result")), self.timeout_s),
        )

    def topic_rules(self, *, offered: bool) -> tuple[TopicRule, ...]:
        """ROS 1: goal and cancel one way, status, feedback and result the other; ROS 2: status and feedback."""
        there, back = (Direction.RECEIVE, Direction.SEND) if offered else (Direction.SEND, Direction.BOTH)
        reliable = Reliability.RELIABLE
        goal, cancel = (
            TopicRule(compile_pattern(self.under(part)), None, PriorityClass.CONTROL, there, None, reliable)
            for part in ("goal", "cancel")
        )
        return (
            # As with ROS 2: a robot must not set off long after it was told to. To stop it is never too late.
            replace(goal, lifespan_s=min(self.timeout_s, SERVICE_TIMEOUT_S)),
            cancel,
            TopicRule(compile_pattern(self.under("result")), None, PriorityClass.STATE, back, None, reliable),
            TopicRule(compile_pattern(self.under(ACTION_STATE)), None, PriorityClass.STATE, back),
        )


class ActionsSection(Section):
    """Actions across the link, of ROS 1 (actionlib) and ROS 2, also from one to the other. Their rules come before
    those of `topics`."""

    offer: tuple[ActionSection, ...] = ()
    """Actions whose server is at this site."""
    use: tuple[ActionSection, ...] = ()
    """Actions of other sites. For ROS 1, whose goals are a topic, this site needs `namespace: "/"`."""

    def topic_rules(self) -> tuple[TopicRule, ...]:
        offered = (rule for section in self.offer for rule in section.topic_rules(offered=True))
        used = (rule for section in self.use for rule in section.topic_rules(offered=False))
        return (*offered, *used)

    def patterns(self) -> tuple[str, ...]:
        """What to subscribe to for the actions of other sites."""
        return tuple(section.under(part) for section in self.use for part in ("result", ACTION_STATE))


class ClientFile(FileModel):
    """Configuration of one client daemon."""

    client: ClientSection
    """Who this client is."""
    relays: Annotated[tuple[RelayConnection, ...], Field(min_length=1, max_length=MAX_RELAYS)] | None = None
    """In place of `relay`: several, each as that section, in the order of preference. The client is at one of them;
    when that does not answer it goes to the next (see `failover`). Unless they form a fabric, who is to hear of each
    other must go to the same one: give all clients the same list."""
    relay: Annotated[RelayConnection | None, Field(validate_default=True)] = None
    """The relay it connects to. Either this or `relays`."""
    failover: FailoverSection = FailoverSection()
    """When it goes from one of `relays` to another; of no use with one relay."""
    endpoint: Annotated[
        Annotated[EndpointSection, Tag("<one>")]
        | Annotated[tuple[EndpointSection, ...], Field(min_length=1), Tag("<list>")],
        Discriminator(one_or_list),
    ]
    """Where messages come from and go to: one mapping, or a list of them. `kind` selects what it is."""
    discovery: DiscoverySection = DiscoverySection()
    """Which topics are offered to the link."""
    topics: tuple[TopicSection, ...] = ()
    """Rules for topics, first match wins. A topic without a rule: bulk, best effort, depth 1, lifespan 1 s."""
    subscribe: tuple[Pattern, ...] = ()
    """Regular expressions for the whole global names that this site wants, beside rules with direction `receive`."""
    on_demand: tuple[Pattern, ...] = ()
    """Regular expressions for the whole global names that people at this site may look at (endpoints of kinds foxglove
    and unity): such a topic comes while somebody looks at it, and no longer. What `subscribe` names comes always."""
    objects: Annotated[tuple[ObjectSelection, ...], Field(max_length=MAX_SELECTIONS)] = ()
    """Cross-reality objects that this site wants, as far as the relay's access rules let it have them: robots,
    obstacles, patches, nodes, and topics with their latest values. It has them under /api/site_objects."""
    scene: SceneSection | None = None
    """The scene that this site shares with others; null: none."""
    services: ServicesSection = ServicesSection()
    """Services offered to other sites and used from them."""
    actions: ActionsSection = ActionsSection()
    """Actions offered to other sites and used from them."""
    durable: DurableSection | None = None
    """Where messages of durable topics are kept; null: there are no such topics."""
    spool: SpoolSection | None = None
    """What this site keeps of its topics whether it is sent or not, and what it fetches of what others have kept; null:
    nothing."""
    scheduler: SchedulerSection = SchedulerSection()
    """Which message the link carries next."""
    adaptation: AdaptationSection | None = None
    """Choose rates, queue limits, compression and redundancy by their predicted cost; null: leave them as they are."""
    link: LinkSection = LinkSection()
    """The link to the relay."""
    link_state: LinkStateSection = LinkStateSection()
    """What this site's nodes are told of the link, and of who is there behind it."""
    http: HttpSection = HttpSection()
    """Metrics and health over HTTP; off by default."""
    local: LocalSection = LocalSection()
    """The socket for tools of this machine."""
    log: LogSection = LogSection()
    """The log."""
    message_log: PathText | None = None
    """CSV file with a line for each message offered, delivered, dropped; null: none. For trials: grows without end."""
    summary: PathText | None = None
    """JSON file with the counters, written at exit; null: none."""

    @classmethod
    def foreign(cls, data: Mapping[str, Data]) -> str | None:
        needed = "a client's is needed here (client, relay, endpoint)"
        if "sern_key" in data:
            return f"is a key file; {needed}"
        relay = data.get("relay")
        if not data.keys() & {"client", "endpoint"} and isinstance(relay, dict) and "listen" in relay:
            return f"is a relay's file, which sern-relay reads; {needed}"
        return None

    @field_validator("relays")
    @classmethod
    def _each_has_its_address(cls, relays: tuple[RelayConnection, ...] | None) -> tuple[RelayConnection, ...] | None:
        seen: dict[str, int] = {}
        for index, each in enumerate(relays or ()):
            before = seen.setdefault(each.endpoint, index)
            if before != index:
                text = f"is that of relays.{before}, too; each relay has an address of its own"
                raise fault(text, index, "endpoint")
        return relays

    @field_validator("relay")
    @classmethod
    def _one_or_several(cls, relay: RelayConnection | None, info: ValidationInfo) -> RelayConnection | None:
        relays = info.data.get("relays", ())  # of a list that is wrong it is said what is
        if relay is None and relays is None:
            raise fault("is missing; or write relays, a list of several")
        if relay is not None and relays is not None:
            raise fault("has no use with relays; put it into that list, the preferred one first")
        return relay

    @model_validator(mode="after")
    def _rules_fit(self) -> "ClientFile":
        try:
            self.rules()
        except RuleError as error:
            raise fault(error.problem, "topics", error.index, error.field) from error
        try:
            PatternSet(self.subscribe_patterns(), max_program=MAX_CLIENT_PROGRAM)
        except PatternError as error:
            what = "" if error.text is None else f"pattern {error.text!r} "
            at = ("subscribe",) if self.subscribe else ()
            raise fault(f"all that it subscribes to: {what}{error}", *at) from error
        return self

    @model_validator(mode="after")
    def _durable_has_a_place(self) -> "ClientFile":
        for index, section in enumerate(self.topics):
            if section.durable and self.durable is None:
                text = "needs a place on disk: durable: {directory: /var/lib/sern/durable}"
                raise fault(text, "topics", index, "durable")
        return self

    @model_validator(mode="after")
    def _twins_are_alone(self) -> "ClientFile":
        for index, section in enumerate(self.endpoints):
            if isinstance(section, TwinEndpoint) and len(self.endpoints) > 1:
                raise fault("twins are the only endpoint of their client: run them in another", "endpoint", index)
        return self

    @property
    def name(self) -> ClientName:
        return ClientName(self.client.name)

    @property
    def all_relays(self) -> tuple[RelayConnection, ...]:
        """The relays in the order of preference, also when the file names just one."""
        if self.relays is not None:
            return self.relays
        return () if self.relay is None else (self.relay,)

    @property
    def namespace(self) -> str:
        return self.client.normal_namespace

    @property
    def endpoints(self) -> tuple[EndpointSection, ...]:
        """The endpoints, also when the file names just one."""
        return self.endpoint if isinstance(self.endpoint, tuple) else (self.endpoint,)

    def rules(self) -> RuleSet:
        """The topic rules as the core reads them."""
        twins = (
            rule for section in self.endpoints if isinstance(section, TwinEndpoint) for rule in section.topic_rules()
        )
        implied = (*self.actions.topic_rules(), *twins)
        rules = (*implied, *(section.rule() for section in self.topics))
        return RuleSet(rules, retention_s=self.link.retention_s, implied=len(implied))

    def offered_services(self) -> tuple[ServiceRule, ...]:
        """Services of this site that others may call, those of actions included."""
        actions = (rule for section in self.actions.offer for rule in section.service_rules())
        return (*(section.rule() for section in self.services.offer), *actions)

    def used_services(self) -> tuple[ServiceRule, ...]:
        """Services of other sites to serve here, those of actions included."""
        actions = (rule for section in self.actions.use for rule in section.service_rules())
        return (*(section.rule() for section in self.services.use), *actions)

    def subscribe_patterns(self) -> tuple[str, ...]:
        """What to ask the relay for, on global names: `subscribe`, rules with direction `receive`, and services."""
        received = self.rules().receive_patterns(self.namespace)
        services = subscriptions(self.name, self.namespace, offer=self.offered_services(), use=self.used_services())
        spooled = () if self.spool is None else self.spool.subscriptions(self.name, self.namespace)
        return tuple(dict.fromkeys((*self.subscribe, *received, *services, *self.actions.patterns(), *spooled)))

    def object_selections(self) -> tuple[Selection, ...]:
        """What to ask the relay for of objects: `objects`, the patches and discrepancies of the scene, and which topics
        there are that people may look at."""
        selections = tuple(section.selection() for section in self.objects)
        if self.scene is not None:
            of_scene = (ObjectKind.PATCH, ObjectKind.DISCREPANCY)
            selections += tuple(Selection(kind, f"/scene/{self.scene.name}/.*") for kind in of_scene)
        if self.on_demand:
            selections += tuple(Selection(kind, valued=False) for kind in TOPIC_KINDS)
        return selections

    def placed(self, base_dir: Path) -> Self:
        if self.relay is not None:
            return self.model_copy(update={"relay": self.relay.placed(base_dir)})
        return self.model_copy(update={"relays": tuple(each.placed(base_dir) for each in self.all_relays)})

    def file_problems(self, base_dir: Path) -> Iterator[FileProblem]:
        for index, relay in enumerate(self.all_relays):
            yield from relay.file_problems(
                base_dir, ("relay",) if self.relays is None else ("relays", index), self.name
            )
        yield from self.http.problems(base_dir)
        if self.scene is not None:
            yield from self.scene.file_problems(base_dir, ("scene",))
        several = isinstance(self.endpoint, tuple)
        for index, endpoint in enumerate(self.endpoints):
            yield from endpoint.file_problems(base_dir, ("endpoint", index) if several else ("endpoint",))
        yield from self._services_only_problems()
        yield from self._pattern_problems()
        for index, section in enumerate(self.topics):
            if section.commands:
                at, reliable = ("topics", index, "lifespan_s"), section.reliability == "reliable"
                yield from lifespan_problem(section.lifespan_s, at, reliable=reliable)
            if section.max_rate_hz is not None and (problem := section.rate_problem()) is not None:
                yield FileProblem(("topics", index, "max_rate_hz"), problem, warning=True)
        yield from output_problems(base_dir, self.message_log, ("message_log",))
        yield from output_problems(base_dir, self.summary, ("summary",))
        if self.durable is not None:
            yield from self.durable.problems(base_dir)
        if self.spool is not None:
            yield from self.spool.problems(base_dir)

    def _services_only_problems(self) -> Iterator[FileProblem]:
        """A warning of endpoints that leave topics to others, where there are none."""
        others = [each for each in self.endpoints if not (isinstance(each, RclpyEndpoint) and each.services_only)]
        if not others:
            problem = "services_only leaves topics to another endpoint, such as one of kind dds, and there is none"
            yield FileProblem(("endpoint",), problem, warning=True)

    def _pattern_problems(self) -> Iterator[FileProblem]:
        """Warnings of patterns that match no name."""
        yield from pattern_problems(self.discovery.allow, ("discovery", "allow"))
        yield from pattern_problems(self.discovery.deny, ("discovery", "deny"))
        for index, topic in enumerate(self.topics):
            yield from pattern_problem(topic.match, ("topics", index, "match"))
        yield from pattern_problems(self.subscribe, ("subscribe",))
        yield from pattern_problems(self.on_demand, ("on_demand",))
        for key, part in (("services", self.services), ("actions", self.actions)):
            for word in ("offer", "use"):
                for index, section in enumerate(getattr(part, word)):
                    yield from pattern_problem(section.match, (key, word, index, "match"))


def load_client(path: Path, *, files: bool = True) -> Loaded[ClientFile]:
    """The client file at `path`; raises ConfigError. `files`: also check the files that it names."""
    return load(path, ClientFile, files=files)
