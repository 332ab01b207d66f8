"""The file of a client daemon (`sern-client`): who it is, its relay, its endpoints, and what to do with which topic."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from sern_core.objects.registry import COMMAND_OBJECT_TYPES
from sern_core.site.object_mirror import Selection
from sern_core.site.services import ServiceRule, subscriptions
from sern_core.summaries.spec import TooLarge
from sern_core.topics.patterns import MAX_CLIENT_PROGRAM, PatternError, PatternSet, compile_pattern
from sern_core.topics.rules import (
    AUTO,
    Direction,
    Discovery,
    DiscoveryMode,
    Lease,
    LossAction,
    Ramp,
    RuleError,
    RuleSet,
    TopicRule,
)
from sern_core.vocabulary.codec_names import DEFAULT_LOSSY, Compression, LossyParams
from sern_core.vocabulary.message import COMMAND_TYPES, DEFAULT_RELIABLE_QUEUE_BYTES
from sern_core.vocabulary.names import name_problem, normal_namespace
from sern_core.vocabulary.types import ClientName, Durability, ObjectKind, PriorityClass, Reliability, TopicName
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.config.base import (
    Bytes,
    ClientText,
    ConnectEndpoint,
    FileModel,
    FileProblem,
    FramePrefix,
    Hertz,
    NamespaceText,
    PathText,
    Pattern,
    Seconds,
    Section,
    TopicText,
    described,
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
from sern_runtime.config.summaries import OneOrMoreSummaries, one_or_list, specs
from sern_runtime.config.twin import TwinEndpoint
from sern_runtime.config.yaml import Data


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


class LossSection(Section):
    """What this site publishes on a command topic when commands stop coming."""

    publish: LossAction
    """`zero`: the all-zero command (stand still), repeated at 10 Hz for 1 s; `ramp`: the last command slower and slower
    within the limits below, for 3 s at the longest, then one all-zero command."""
    after_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    """Without a fresh command for so long, whatever the cause: counted from when the last one was given. A ramp begins
    earlier, where the commands came more often than that."""
    hold_s: Annotated[float, Field(ge=0, le=10)] = 0.125
    """`ramp`: how late the next command may be, past the usual time between commands (the median of the last 8), before
    the robot is slowed down. This much jitter of the link it does not notice."""
    linear_mps2: Annotated[float, Field(gt=0, le=1000)] = 2.0
    """`ramp`: the fastest that it is slowed down, m/s². Both velocities shrink together: it stays on its arc."""
    angular_radps2: Annotated[float, Field(gt=0, le=1000)] = 4.0
    """`ramp`: the same of its turning, rad/s²."""

    @model_validator(mode="after")
    def _of_a_ramp(self) -> "LossSection":
        for key in ("hold_s", "linear_mps2", "angular_radps2"):
            if self.publish is not LossAction.RAMP and key in self.model_fields_set:
                raise fault("belongs to publish: ramp; leave it out, or choose that", key)
        return self

    def lease(self) -> Lease:
        """The lease as the core reads it."""
        ramp = Ramp(self.hold_s, self.linear_mps2, self.angular_radps2) if self.publish is LossAction.RAMP else None
        return Lease(self.publish, self.after_s, ramp)


class HolderSection(Section):
    """Of several operators that send a command topic one holds it: `sern take` (docs/driving.md)."""

    lapse_s: Annotated[float, Field(ge=0.5, le=600)] = 5.0
    """Without a command of the holder for so long nobody holds it. What the robot's file says counts."""


class EStopSection(Section):
    """A message of this topic is an emergency stop: a std_msgs/Bool that is true, or any message of another type."""

    stops: tuple[Pattern, ...] = ("/cmd_vel",)
    """Topics (local names) whose commands of other sites are refused until it is released, by `sern release`."""
    file: PathText | None = None
    """Where it is kept that it is latched; null: NAME.e_stop in the unit's state directory, else beside this file. All
    e-stops of a client have the same."""


_COMMAND: Final = re.compile("cmd|command|joy|teleop|twist", re.IGNORECASE)
"""What the names of command topics have in them."""
_COMMAND_TYPE: Final = re.compile("Twist|AckermannDrive|JointJog|JointTrajectory")
"""What patterns have in them that are of types of commands, and not of whatever there is."""


class TopicSection(Section):
    """One rule. The first rule that matches a topic holds for it."""

    match: Pattern
    """Regular expression for the whole topic name, as this site calls it (local name)."""
    type: Pattern | None = None
    """Regular expression for the whole message type, such as sensor_msgs/PointCloud2; null: any."""
    priority: Annotated[ClassWord, Field(alias="class")] = "bulk"
    """Urgency: `control` (commands, pose, timing), `state` (maps, obstacle summaries), `bulk` (clouds, images)."""
    direction: Direction = Direction.BOTH
    """`send`: from here to the link; `receive`: from the link to here, and subscribe to it; `both`: both, but
    receive only what `subscribe` asks for."""
    weight: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """κ of the score, within a class; null: 10, 3, 1 for control, state, bulk."""
    reliability: Literal["auto", "reliable", "best_effort"] = "auto"
    """`reliable`: kept and resent until delivered or `retention_s` is over; `best_effort`: freshest first;
    `auto`: as the publisher offers (ROS 1: reliable if latched)."""
    durability: Literal["auto", "volatile", "transient_local"] = "auto"
    """`transient_local`: the last `depth` messages, at most 1,000, reach late joiners; `auto`: as the publisher
    offers."""
    history: Literal["keep_last"] = "keep_last"
    """The only kind of history there is; its length is `depth`."""
    depth: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Messages kept; null: 10 if reliable, else 1."""
    lifespan_s: Annotated[
        Annotated[float, Field(gt=0, le=1e7)] | Literal["auto"] | None,
        described("a number of seconds above 0, null (for ever) or auto"),
    ] = "auto"
    """Older messages are not sent and not delivered, nor is a large one begun that cannot arrive by then; null: for
    ever; `auto`: 0.3 for velocity commands in class control, for ever if reliable or transient_local, else 1."""
    deadline_s: Seconds | None = None
    """Expected time between messages: longer gaps are reported; null: no expectation."""
    max_rate_hz: Hertz | None = None
    """Faster messages of a best-effort topic are thinned to this rate; null: all. The newest waits for its turn, so the
    last one always goes. Leave commands without: they would wait, too."""
    durable: bool = False
    """Reliable, and kept on disk from the moment it is taken until it is delivered: it outlives the end of this process
    and of the machine's power. Needs the section `durable`; on TOPIC/sern/stored this site's nodes see how many are on
    disk. Not for commands."""
    retention_s: Seconds | None = None
    """How long an undelivered reliable message is kept; null: `link.retention_s`, and 7 days where it is durable."""
    max_queue_bytes: Bytes = DEFAULT_RELIABLE_QUEUE_BYTES
    """Undelivered reliable messages kept at most, each counted with 768 bytes beside its own; beyond, new ones are
    refused to their publisher."""
    compression: Literal["auto", "none", "lz4", "zstd", "zstd_strong", "voxel_draco", "jpeg"] = "auto"
    """How bodies from here are compressed; `auto`: whichever gets a message there soonest, by what each makes of the
    topic and what the link carries, among the lossless ones and those in `lossy`. A body that gains less than 3 % is
    sent as it is."""
    lossy: tuple[Literal["voxel_draco", "jpeg"], ...] = ()
    """Modes that may lose something: `voxel_draco` thins point clouds (x, y and z survive), `jpeg` is for images of
    8-bit colour or grey. Both ends need the extra `lossy`."""
    voxel_m: Annotated[float, Field(gt=0, le=1000)] = DEFAULT_LOSSY.voxel_m
    """Edge of a voxel of `voxel_draco`; each becomes one point, exact to a twentieth of it."""
    jpeg_quality: Annotated[int, Field(ge=1, le=95)] = DEFAULT_LOSSY.jpeg_quality
    """Quality of `jpeg`."""
    many_writers: bool | None = None
    """Several clients may publish this global name; null: only /tf and /tf_static."""
    remap: TopicText | None = None
    """Another name for this topic outside this site, before the namespace; needs a plain name in `match`."""
    e_stop: EStopSection | None = None
    """Its messages, from here or from elsewhere, latch an emergency stop at this client; needs a plain name in
    `match`. What is released by name stays released."""
    holder: HolderSection | None = None
    """One operator at a time commands by this topic, `many_writers` then being true: in the robot's file, with a plain
    name in `match`, and in the files of operators."""
    on_link_loss: LossSection | None = None
    """What to publish when commands stop, for topics of type geometry_msgs/Twist or TwistStamped that come in."""
    summary: OneOrMoreSummaries = ()
    """Send something smaller in place of heavy messages, or beside them: one mapping, or a list of them. `kind`
    selects what it is."""
    too_large: Literal["summary", "drop"] = "summary"
    """What goes while the link is too slow for a point cloud to arrive within its lifespan: `summary` sends each one
    thinned to a point in 0.2 m under the same name, `drop` nothing. It holds for clouds of class bulk that are best
    effort and have no `summary`."""
    merge_tf: bool | None = None
    """For tf2_msgs/TFMessage: many messages become one with the newest transform of each pair of frames, at most
    `max_rate_hz` (20) a second, of /tf_static one with all there are; null: /tf_static always, others in class state
    unless `reliability` is reliable."""
    dead_reckoning: bool = False
    """For nav_msgs/Odometry: a pose is sent when the twin of who receives it would be off by 2 cm or a degree without,
    and 0.2 s after the one before at the latest. At the best a tenth of 50 a second is left. Leave it out for
    receivers that need every pose, such as a recording for later."""

    @model_validator(mode="after")
    def _summaries_fit(self) -> "TopicSection":
        found = specs(self.summary)
        if len(found) > 1 and any(spec.shares_topic for spec in found):
            raise fault(
                "patches and in_place voxels take the topic for themselves; give no other beside them", "summary"
            )
        names = [spec.topic("") for spec in found]
        if len(set(names)) < len(names):
            raise fault("gives two summaries one name; use `as`", "summary")
        if any(spec.name is not None and spec.name.startswith("/") for spec in found) and name_problem(self.match):
            raise fault("`as` is a whole topic name, which needs a plain name in `match`", "summary")
        if len({spec.adapt for spec in found}) > 1:
            raise fault("sends all its summaries or none: give every one of them the same `adapt`", "summary")
        if len({spec.by_link for spec in found}) > 1:
            raise fault("sends all its summaries or none: give every one of them `level: auto`, or none", "summary")
        if found and self.direction is Direction.RECEIVE:
            raise fault("is made where messages leave; direction is receive", "summary")
        return self

    @model_validator(mode="after")
    def _consistent(self) -> "TopicSection":
        if self.compression in ("voxel_draco", "jpeg") and self.compression not in self.lossy:
            raise fault(f"{self.compression} loses something; name it in lossy as well", "compression")
        if self.dead_reckoning and self.reliability == "reliable":
            raise fault(
                "leaves poses out, and of a reliable topic every message counts; use best_effort", "dead_reckoning"
            )
        if self.durable:
            for key, given, why in (
                (
                    "reliability",
                    self.reliability == "best_effort",
                    "is best_effort, and of a durable topic every message counts",
                ),
                ("summary", bool(self.summary), "is not for a durable topic, of which every message is kept as it is"),
                (
                    "dead_reckoning",
                    self.dead_reckoning,
                    "leaves poses out, and of a durable topic every message counts",
                ),
                ("merge_tf", bool(self.merge_tf), "leaves transforms out, and of a durable topic every message counts"),
                ("durable", self.commands, "keeps commands for later, which a robot must never get; leave it out"),
            ):
                if given:
                    raise fault(why, key)
        if self.holder is not None and self.many_writers is False:
            raise fault("is of several operators' topics; leave many_writers out", "holder")
        if self.holder is not None and self.direction is not Direction.SEND and name_problem(self.match):
            raise fault("is of one topic of this robot: a plain name in `match`, or direction: send", "holder")
        if self.e_stop is not None and name_problem(self.match):
            raise fault("is of one topic, which needs a plain name in `match`", "e_stop")
        if self.on_link_loss is not None:
            if self.direction is Direction.SEND:
                raise fault("acts where commands arrive; direction is send", "on_link_loss")
            if self.type is not None and not self._takes(COMMAND_TYPES):
                allowed = ", ".join(sorted(COMMAND_TYPES))
                raise fault(f"is only for {allowed}; type {self.type!r} matches neither", "on_link_loss")
        return self

    def rate_problem(self) -> str | None:
        """What a limit on the rate does here that is hardly meant; None when it does what it says."""
        if self.reliability == "reliable" and not self.merge_tf:
            return "has no effect on a reliable topic, of which every message counts; leave it out, or use best_effort"
        if self.priority == "control" and _COMMAND.search(self.match):
            return f"lets a command wait for up to {1.0 / (self.max_rate_hz or 1.0):.3g} s; leave it out"
        return None

    @property
    def commands(self) -> bool:
        """Whether what it names can move a robot, whatever its class, as far as the file tells."""
        if self.priority == "control" or self.on_link_loss is not None or _COMMAND.search(self.match):
            return True
        named = self.type is not None and _COMMAND_TYPE.search(self.type) is not None
        return named and self._takes(COMMAND_OBJECT_TYPES)

    def _takes(self, types: frozenset[str]) -> bool:
        """Whether it is for one of these types, in either spelling."""
        pattern = compile_pattern(self.type or ".*")
        spellings = [name for plain in types for name in (plain, plain.replace("/", "/msg/"))]
        return any(pattern.fullmatch(name) for name in spellings)

    def rule(self) -> TopicRule:
        """The rule as the core reads it."""
        loss = self.on_link_loss
        return TopicRule(
            match=compile_pattern(self.match),
            type_match=None if self.type is None else compile_pattern(self.type),
            priority=PriorityClass[self.priority.upper()],
            direction=self.direction,
            weight=self.weight,
            reliability=None if self.reliability == "auto" else Reliability(self.reliability),
            durability=None if self.durability == "auto" else Durability(self.durability),
            depth=self.depth,
            lifespan_s=AUTO if self.lifespan_s == "auto" else self.lifespan_s,
            deadline_s=self.deadline_s,
            max_rate_hz=self.max_rate_hz,
            retention_s=self.retention_s,
            max_queue_bytes=self.max_queue_bytes,
            many_writers=self.many_writers,
            remap=None if self.remap is None else TopicName(self.remap),
            compression=None if self.compression == "auto" else Compression(self.compression),
            lossy=tuple(Compression(mode) for mode in self.lossy),
            lossy_params=LossyParams(self.voxel_m, self.jpeg_quality),
            hold_lapse_s=None if self.holder is None else self.holder.lapse_s,
            lease=None if loss is None else loss.lease(),
            summaries=specs(self.summary),
            too_large=TooLarge(self.too_large),
            merge_tf=self.merge_tf,
            dead_reckoning=self.dead_reckoning,
            durable=self.durable,
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
    relay: RelayConnection
    """The relay it connects to."""
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
        relay = self.relay.model_copy(update={"endpoint": place(base_dir, self.relay.endpoint)})
        return self.model_copy(update={"relay": relay})

    def file_problems(self, base_dir: Path) -> Iterator[FileProblem]:
        yield from socket_problems(base_dir, self.relay.endpoint, ("relay", "endpoint"))
        yield from self.http.problems(base_dir)
        if self.scene is not None:
            yield from self.scene.file_problems(base_dir, ("scene",))
        if self.relay.server_key_file is not None:
            loc = ("relay", "server_key_file")
            yield from public_key_problems(base_dir, self.relay.server_key_file, loc, client=self.name)
        if self.relay.secret_key_file is not None:
            loc = ("relay", "secret_key_file")
            yield from secret_key_problems(base_dir, self.relay.secret_key_file, loc, owner=self.name)
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
