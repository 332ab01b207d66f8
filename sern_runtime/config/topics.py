"""What a client's file says of its topics: a rule each (`topics`)."""

import re
from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from sern_core.objects.registry import COMMAND_OBJECT_TYPES
from sern_core.summaries.spec import TooLarge
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.rules import AUTO, Direction, Lease, LossAction, Ramp, TopicRule
from sern_core.vocabulary.codec_names import DEFAULT_LOSSY, Compression, LossyParams
from sern_core.vocabulary.message import COMMAND_TYPES, DEFAULT_RELIABLE_QUEUE_BYTES
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import Durability, PriorityClass, Reliability, TopicName
from sern_runtime.config.base import Bytes, Hertz, PathText, Pattern, Seconds, Section, TopicText, described, fault
from sern_runtime.config.shared import ClassWord
from sern_runtime.config.summaries import OneOrMoreSummaries, specs


class LossSection(Section):
    """What this site publishes on a command topic when commands stop coming."""

    publish: LossAction
    """`zero`: the all-zero command (stand still), repeated at 10 Hz for 1 s; `ramp`: the last command slower and slower
    within the limits below, for 3 s at the longest, then one all-zero command."""
    after_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    """How long a command holds at the longest, counted from when it was given, whatever keeps the next one away. A ramp
    begins earlier, where commands came more often than that."""
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
    """One of several operators holds a command topic, and hands it over by `sern take` (docs/driving.md)."""

    lapse_s: Annotated[float, Field(ge=0.5, le=600)] = 5.0
    """How long the holder may send no command; then nobody holds it. What the robot's file says counts."""


class EStopSection(Section):
    """A message of this topic is an emergency stop: a std_msgs/Bool that is true, or any message of another type."""

    stops: tuple[Pattern, ...] = ("/cmd_vel",)
    """Topics (local names) whose commands of other sites are refused until it is released, by `sern release`."""
    file: PathText | None = None
    """The file that keeps what is latched; null: NAME.e_stop in the unit's state directory, else beside this file. All
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
