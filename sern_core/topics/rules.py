"""Names and topic rules: what the configuration says about a topic, as plain data.

Rules of this file:
- every pattern is a regular expression that must match the whole name (patterns.py);
- the first rule that matches wins; nothing is merged;
- a *local* name is what the endpoint of one site calls a topic, a *global* name is what everyone else calls it;
- all values here were checked by the configuration, and the functions below still refuse what would be unsafe.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Final

from sern_core.summaries.spec import SummarySpec, TooLarge, stand_ins
from sern_core.summaries.transforms import TF_TYPES, is_static
from sern_core.topics.patterns import Pattern, PatternSet, compile_pattern
from sern_core.vocabulary.codec_names import DEFAULT_LOSSY, Compression, LossyParams
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import (
    COMMAND_TYPES,
    DEFAULT_COMMAND_LIFESPAN_S,
    DEFAULT_LIFESPAN_S,
    DEFAULT_RELIABLE_QUEUE_BYTES,
    DEFAULT_RETENTION_S,
    DURABLE_RETENTION_S,
    KAPPA,
    TopicInfo,
    TopicSpec,
)
from sern_core.vocabulary.names import in_namespace, name_problem, plain_type, to_global, to_local
from sern_core.vocabulary.types import ClientName, Durability, Encoding, PriorityClass, Reliability, TopicName

DEFAULT_RELIABLE_DEPTH: Final = 10
DEFAULT_BEST_EFFORT_DEPTH: Final = 1

ODOMETRY_TYPE: Final = "nav_msgs/Odometry"
"""The one type of poses that `dead_reckoning` is for: it says how fast the robot is."""
MANY_WRITER_TOPICS: Final = frozenset({"/tf", "/tf_static"})
"""Topics that several nodes own by convention of ROS; `many_writers` defaults to true for them."""


class Auto(Enum):
    """The value of a setting that follows from the rest (class, type, what the publisher offers)."""

    AUTO = "auto"


AUTO: Final = Auto.AUTO


# Names ---------------------------------------------------------------------------------------------------------------


def matches_any(patterns: Iterable[PatternSet], name: str) -> bool:
    return any(pattern.fullmatch(name) for pattern in patterns)


def type_matches(patterns: tuple[PatternSet, ...], type_name: str) -> bool:
    """Whether one of the patterns is of this type, in either spelling."""
    return matches_any(patterns, type_name) or matches_any(patterns, plain_type(type_name))


# Topic rules ---------------------------------------------------------------------------------------------------------


class Direction(StrEnum):
    SEND = "send"  # from this site's endpoint to the link
    RECEIVE = "receive"  # from the link to this site's endpoint
    BOTH = "both"

    @property
    def sends(self) -> bool:
        return self is not Direction.RECEIVE

    @property
    def receives(self) -> bool:
        return self is not Direction.SEND


class LossAction(StrEnum):
    ZERO = "zero"  # the all-zero message of the topic's type
    RAMP = "ramp"  # the last command, slower and slower, then one of zero


@dataclass(frozen=True, slots=True)
class Ramp:
    """How a robot is slowed down when commands stay away: a command holds for `hold_s` past the usual time between
    commands, then its velocities shrink by no more than these limits (m/s² and rad/s²)."""

    hold_s: float
    linear_mps2: float
    angular_radps2: float


@dataclass(frozen=True, slots=True)
class Lease:
    """A command topic is a lease: without a fresh command for `after_s`, whatever the cause, `publish` happens. `ramp`:
    how, and how much earlier, where it is a ramp."""

    publish: LossAction
    after_s: float
    ramp: Ramp | None = None


@dataclass(frozen=True, slots=True)
class TopicRule:
    """One line of `topics:`. `match` is tried on the local name, `type_match` on both spellings of the type.

    AUTO and None stand for the defaults that `RuleSet.resolve` documents; `lifespan_s` None means for ever.
    """

    match: Pattern
    type_match: Pattern | None = None
    priority: PriorityClass = PriorityClass.BULK
    direction: Direction = Direction.BOTH
    weight: float | None = None
    reliability: Reliability | None = None
    durability: Durability | None = None
    depth: int | None = None
    lifespan_s: float | Auto | None = AUTO
    deadline_s: float | None = None
    max_rate_hz: float | None = None
    retention_s: float | None = None
    max_queue_bytes: int = DEFAULT_RELIABLE_QUEUE_BYTES
    many_writers: bool | None = None
    remap: TopicName | None = None
    lease: Lease | None = None
    hold_lapse_s: float | None = None
    compression: Compression | None = None
    summaries: tuple[SummarySpec, ...] = ()
    too_large: TooLarge = TooLarge.SUMMARY
    merge_tf: bool | None = None
    dead_reckoning: bool = False
    lossy: tuple[Compression, ...] = ()
    lossy_params: LossyParams = DEFAULT_LOSSY
    durable: bool = False

    @property
    def plain_name(self) -> TopicName | None:
        """The one topic this rule is about, when `match` is a name without any wildcard."""
        text = self.match.pattern
        return TopicName(text) if name_problem(text) is None else None

    def accepts(self, local_name: TopicName, type_name: str) -> bool:
        if not self.match.fullmatch(local_name):
            return False
        if self.type_match is None:
            return True
        return type_matches((self.type_match,), type_name)


@dataclass(frozen=True, slots=True)
class ResolvedTopic:
    """What the rules say about one topic. `rule` is the index of the rule, None when no rule matched.

    `name` is the local name after `remap`: the one to give to `to_global`. `merge_tf`: it carries transforms, to be
    merged on their way out. `dead_reckoning`: it carries poses, and those go out that a twin would be wrong
    without. `hold_lapse_s`: one operator at a time commands by it, who may be silent for so long.
    """

    spec: TopicSpec
    direction: Direction
    name: TopicName
    lease: Lease | None
    rule: int | None
    summaries: tuple[SummarySpec, ...] = ()
    merge_tf: bool = False
    dead_reckoning: bool = False
    hold_lapse_s: float | None = None


class RuleError(UsageError):
    """Rule `index` can not work together with the others. `field` is the key at fault."""

    def __init__(self, index: int, field_name: str, problem: str) -> None:
        super().__init__(f"topics.{index}.{field_name}: {problem}")
        self.index = index
        self.field = field_name
        self.problem = problem


@dataclass(frozen=True, slots=True)
class RuleSet:
    """The `topics:` of one client. Raises RuleError when two rules contradict each other.

    `retention_s` is the default for reliable topics whose rule gives none.
    """

    rules: tuple[TopicRule, ...] = ()
    retention_s: float = DEFAULT_RETENTION_S
    implied: int = 0
    """How many rules at the front follow from other sections; places in messages count from the one after them."""
    _inward: dict[TopicName, TopicName] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        inward: dict[TopicName, TopicName] = {}
        for index, rule in enumerate(self.rules):
            name = rule.plain_name
            if rule.remap is not None and (name is None or rule.type_match is not None):
                raise RuleError(index - self.implied, "remap", "needs a plain topic name in `match` and no `type`")
            if name is not None:
                self._refuse_shadowed(index, rule, name)
            if rule.remap is not None and name is not None:
                if rule.remap in inward:
                    raise RuleError(
                        index - self.implied, "remap", f"{rule.remap} is already the new name of {inward[rule.remap]}"
                    )
                inward[rule.remap] = name
        object.__setattr__(self, "_inward", inward)

    def _refuse_shadowed(self, index: int, rule: TopicRule, name: TopicName) -> None:
        """A rule for one name after a rule that takes that name would never be used: always a mistake."""
        for earlier_index, earlier in enumerate(self.rules[:index]):
            certain = earlier.type_match is None or rule.remap is not None
            if certain and earlier.match.fullmatch(name):
                place = f"topics.{earlier_index - self.implied}" if earlier_index >= self.implied else "actions"
                problem = f"is never used: {place} ({earlier.match.pattern!r}) matches first; move it up"
                raise RuleError(index - self.implied, "match", problem)

    def find(self, type_name: str, local_name: TopicName) -> int | None:
        """The index of the first rule that matches, or None."""
        for index, rule in enumerate(self.rules):
            if rule.accepts(local_name, type_name):
                return index
        return None

    def resolve(self, info: TopicInfo, *, local_name: TopicName) -> ResolvedTopic:
        """What to do with the topic that this site calls `local_name`.

        No rule: bulk, best effort, depth 1, lifespan 1 s; of the publisher's QoS only the latch is kept. Else, where
        the rule says nothing:
        - reliability, durability: the publisher's; a publisher that does not say (ROS 1) is reliable if it latches;
          a durable topic is reliable;
        - depth: 10 if reliable, else 1;
        - lifespan and deadline: the publisher's, where it has any (DDS); else no deadline, and
        - lifespan: 0.3 s for a velocity command in class control; for ever if reliable or latched; else 1 s;
        - summaries: for clouds of class bulk that are best effort, a thinner one where the link is too slow for them;
        - weight κ: by class; many_writers: true for `/tf` and `/tf_static`;
        - dead_reckoning: for no topic, and for none but of odometry;
        - merge_tf: for transforms in class state unless the rule makes them reliable, and for `/tf_static` and other
          latched ones with or without a rule.

        Raises ConfigError when the rule has `on_link_loss` and the type is known to be no velocity command, and when
        the topic has the name that `remap` gave to another one.
        """
        index = self.find(info.type_name, local_name)
        durability = Durability.TRANSIENT_LOCAL if info.latched else Durability.VOLATILE
        many_writers = local_name in MANY_WRITER_TOPICS
        transforms = plain_type(info.type_name) in TF_TYPES
        static = transforms and (info.latched or is_static(local_name))
        if local_name in self._inward and (index is None or self.rules[index].remap is None):
            raise ConfigError(
                f"{local_name} is a local topic and also the new name that `remap` gives to {self._inward[local_name]}"
            )
        if index is None:
            spec = TopicSpec(
                durability=durability,
                lifespan_s=None if info.latched else DEFAULT_LIFESPAN_S,
                many_writers=many_writers,
                retention_s=self.retention_s,
            )
            return ResolvedTopic(spec, Direction.BOTH, local_name, None, None, stand_ins(info, spec), merge_tf=static)
        rule = self.rules[index]
        command = plain_type(info.type_name) in COMMAND_TYPES
        if rule.lease is not None and info.type_name and not command:
            raise ConfigError(
                f"{local_name} is {info.type_name}; on_link_loss can publish only {', '.join(sorted(COMMAND_TYPES))}",
                key=f"topics.{index - self.implied}.on_link_loss",
            )
        durability = rule.durability or durability
        reliability = Reliability.RELIABLE if rule.durable else rule.reliability or _offered_reliability(info)
        reliable = reliability is Reliability.RELIABLE
        if rule.lifespan_s is not AUTO:
            lifespan_s = rule.lifespan_s
        elif info.lifespan_s is not None:
            lifespan_s = info.lifespan_s
        elif command and rule.priority is PriorityClass.CONTROL:
            lifespan_s = DEFAULT_COMMAND_LIFESPAN_S
        else:
            lifespan_s = None if reliable or durability is Durability.TRANSIENT_LOCAL else DEFAULT_LIFESPAN_S
        spec = TopicSpec(
            priority=rule.priority,
            weight=KAPPA[rule.priority] if rule.weight is None else rule.weight,
            reliability=reliability,
            durability=durability,
            depth=rule.depth or (DEFAULT_RELIABLE_DEPTH if reliable else DEFAULT_BEST_EFFORT_DEPTH),
            lifespan_s=lifespan_s,
            deadline_s=info.deadline_s if rule.deadline_s is None else rule.deadline_s,
            max_rate_hz=rule.max_rate_hz,
            retention_s=self._retention_s(rule),
            max_queue_bytes=rule.max_queue_bytes,
            many_writers=many_writers or rule.hold_lapse_s is not None
            if rule.many_writers is None
            else rule.many_writers,
            compression=rule.compression,
            lossy=rule.lossy,
            lossy_params=rule.lossy_params,
            durable=rule.durable,
        )
        every_one_counts = rule.durable or rule.reliability is Reliability.RELIABLE
        merge_tf = static or (transforms and rule.priority is PriorityClass.STATE and not every_one_counts)
        if rule.merge_tf is not None:
            merge_tf = transforms and rule.merge_tf
        merge_tf = merge_tf and not rule.durable
        name = rule.remap or local_name
        summaries = rule.summaries
        if not summaries and rule.too_large is TooLarge.SUMMARY:
            summaries = stand_ins(info, spec)
        reckoned = rule.dead_reckoning and plain_type(info.type_name) == ODOMETRY_TYPE
        held = rule.hold_lapse_s
        return ResolvedTopic(spec, rule.direction, name, rule.lease, index, summaries, merge_tf, reckoned, held)

    def _retention_s(self, rule: TopicRule) -> float:
        if rule.retention_s is not None:
            return rule.retention_s
        return DURABLE_RETENTION_S if rule.durable else self.retention_s

    def outward(self, info: TopicInfo, *, local_name: TopicName, namespace: str) -> TopicName:
        """The global name of a local topic: `remap`, then the namespace."""
        return to_global(self.resolve(info, local_name=local_name).name, namespace)

    def inward(self, name: TopicName, *, namespace: str) -> TopicName:
        """The local name of a global one: out of the own namespace, then `remap` backwards.

        `inward(outward(x)) == x`. A remap holds for this site's own names, and with the namespace `/` for all.
        """
        local = to_local(name, namespace)
        return self._inward.get(local, local) if in_namespace(name, namespace) else local

    def receive_patterns(self, namespace: str) -> tuple[str, ...]:
        """What to subscribe to because of rules with direction `receive`: patterns of global names.

        The pattern of a late rule may cover names that an earlier rule takes; `resolve` has the last word.
        """
        prefix = "" if namespace == "/" else namespace
        return tuple(
            f"{prefix}(?:{rule.remap or rule.match.pattern})"
            for rule in self.rules
            if rule.direction is Direction.RECEIVE
        )


def _offered_reliability(info: TopicInfo) -> Reliability:
    """The publisher's reliability; where the middleware does not say, latched means that each sample matters."""
    reliable = info.latched if info.reliable is None else info.reliable
    return Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT


class DiscoveryMode(StrEnum):
    MANUAL = "manual"  # only topics that a rule names
    DYNAMIC = "dynamic"  # everything that `allow` lets through, with or without a rule


@dataclass(frozen=True, slots=True)
class Discovery:
    """Which local topics are offered to the link at all."""

    mode: DiscoveryMode = DiscoveryMode.MANUAL
    allow: tuple[Pattern, ...] = (compile_pattern(".*"),)
    deny: tuple[Pattern, ...] = ()
    allow_types: tuple[Pattern, ...] = (compile_pattern(".*"),)
    deny_types: tuple[Pattern, ...] = ()

    def wants(self, local_name: TopicName, type_name: str, *, listed: bool) -> bool:
        """`listed`: some rule matches the topic. What is denied, by name or type, is out; then the mode and what is
        allowed, by name and type, both decide."""
        if matches_any(self.deny, local_name) or not matches_any(self.allow, local_name):
            return False
        if type_matches(self.deny_types, type_name) or not type_matches(self.allow_types, type_name):
            return False
        return listed or self.mode is DiscoveryMode.DYNAMIC


# The feed -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FeedTopic:
    """What a topic is that programs publish into the feed. `rule.match` is a pattern of global names."""

    rule: TopicRule
    type_name: str
    encoding: Encoding


@dataclass(frozen=True, slots=True)
class FeedRole:
    """One pair of plain ZMQ sockets on the relay. `ingest_endpoint` None: nobody can publish through this role.

    `types`: what goes on to the clients, first match wins; anything else stays within the feed. The limits are for what
    comes in, of all its programs together; None: unlimited.
    """

    name: str
    publish_endpoint: str
    ingest_endpoint: str | None = None
    subscribe: tuple[Pattern, ...] = ()
    publish: tuple[Pattern, ...] = ()
    allow_control: bool = False
    types: tuple[FeedTopic, ...] = ()
    max_rate_hz: float | None = None
    max_bytes_per_s: float | None = None

    @property
    def owner(self) -> ClientName:
        """The name under which the relay publishes what comes in through this role."""
        return ClientName("feed_" + self.name.replace("-", "_"))

    def topic(self, name: TopicName) -> FeedTopic | None:
        """What the role publishes under this name; None where nothing says so."""
        return next((topic for topic in self.types if topic.rule.match.fullmatch(name)), None)

    def may_see(self, name: TopicName) -> bool:
        return matches_any(self.subscribe, name)

    def may_publish(self, name: TopicName, priority: PriorityClass) -> bool:
        if priority is PriorityClass.CONTROL and not self.allow_control:
            return False
        return matches_any(self.publish, name)
