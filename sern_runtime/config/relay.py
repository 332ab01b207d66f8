"""The file of the relay daemon (`sern-relay`): where it listens, who may do what, and its limits."""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sern_core.objects.registry import COMMAND_OBJECT_TYPES
from sern_core.relay.access import DEFAULT_QUEUE_BYTES, AccessRule
from sern_core.topics.patterns import PatternSet, compile_pattern
from sern_core.topics.rules import AUTO, FeedRole, FeedTopic, TopicRule
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.names import client_name, plain_type
from sern_core.vocabulary.types import ClientName, Durability, Encoding, PriorityClass, Reliability
from sern_runtime import ros_types
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.config.base import (
    BindEndpoint,
    Bytes,
    ClientText,
    Count,
    FileModel,
    FileProblem,
    Hertz,
    HttpListen,
    PathText,
    Pattern,
    RoleText,
    Section,
    SelfPattern,
    described,
    fault,
    is_local,
    lifespan_problem,
    pattern_problem,
    pattern_problems,
    place,
    resolve,
    socket_problems,
)
from sern_runtime.config.fabric import FabricSection
from sern_runtime.config.keys import KeyDirectory
from sern_runtime.config.load import Loaded, load
from sern_runtime.config.shared import (
    ClassWord,
    DurableSection,
    HttpSection,
    LinkSection,
    LogSection,
    SchedulerSection,
    output_problems,
    secret_key_problems,
)
from sern_runtime.config.yaml import Data

DEFAULT_HTTP_LISTEN = "127.0.0.1:5580"
_SOCKETS = ("publish_endpoint", "ingest_endpoint")


class RelaySection(Section):
    """The relay itself."""

    name: ClientText
    """Its name, as in its key file."""
    listen: Annotated[tuple[BindEndpoint, ...], Field(min_length=1, max_length=16)]
    """Where clients connect: tcp://address:port, tcp://*:port (every one of IPv4 and IPv6), ipc://path (a relative one
    starts at this file); one or more."""
    secret_key_file: PathText | None = None
    """The relay's secret key file (.key)."""
    clients_dir: PathText | None = None
    """Directory with the public key files (.pub) of the clients that may connect."""
    udp: bool = True
    """Offer clients the datagram lane, on the UDP ports with the numbers of `listen`; not with insecure: true."""
    insecure: bool = False
    """No keys and no encryption, clients are who they say they are; only for ipc and loopback."""
    max_connections: Count = 256
    """Connections at a time, beyond which new ones are refused."""
    rotate_keys: bool = False
    """Take a further key of a client's own that it asks for inside its session (`sern keys rotate`), and write it to
    its file in `clients_dir`, which this process must be allowed to do."""
    key_overlap_s: Annotated[float, Field(ge=1, le=1e8)] = 86_400.0
    """How long the key with which a client asked for a further one still holds."""
    handshake_interval_s: Annotated[float, Field(ge=1, le=120)] = 10.0
    """Time for a connection to prove its key. It takes 4 round trips: below 5 s satellite links are locked out."""

    @property
    def overlap_s(self) -> float | None:
        """How long an old key overlaps with a new one; None: clients bring none."""
        return self.key_overlap_s if self.rotate_keys else None

    @model_validator(mode="after")
    def _keys(self) -> "RelaySection":
        if len(set(self.listen)) != len(self.listen):
            raise fault("names an address twice", "listen")
        keys = ("secret_key_file", "clients_dir")
        if self.insecure:
            for index, endpoint in enumerate(self.listen):
                if not is_local(endpoint):
                    raise fault(
                        "is open to the network, and insecure: true is only for ipc and loopback", "listen", index
                    )
            for key in keys:
                if getattr(self, key) is not None:
                    raise fault("has no use with insecure: true; remove one of the two", key)
            return self
        for key in keys:
            if getattr(self, key) is None:
                raise fault("is missing; make keys with sern keygen (insecure: true only on one machine)", key)
        return self


class RelayHttpSection(HttpSection):
    """The HTTP server with the page to watch it by, /metrics, /healthz and /readyz."""

    listen: HttpListen | None = DEFAULT_HTTP_LISTEN
    """`address:port`; null: no HTTP server. Beyond loopback `token_file` is needed."""


class AccessSection(Section):
    """What some clients may do. The first rule that matches a client's name holds for it; without one, nothing."""

    client: Pattern
    """The client's name, or a regular expression for the whole of it."""
    publish: tuple[SelfPattern, ...] = ()
    """Patterns of the global names it may publish; `{self}` is its own name."""
    subscribe: tuple[SelfPattern, ...] = ()
    """Patterns of the global names it may receive; `{self}` is its own name."""
    replay: tuple[SelfPattern, ...] | None = None
    """Patterns of the names whose earlier messages it may be sent too; null: as `subscribe`."""
    max_rate_hz: Hertz | None = None
    """Messages a second taken from it over all its topics; null: no limit."""
    max_bytes_per_s: Annotated[float, Field(gt=0, le=1e12)] | None = None
    """Bytes a second taken from it over all its topics; null: no limit."""
    max_queue_bytes: Bytes | None = DEFAULT_QUEUE_BYTES
    """Bytes that may wait for it at the relay, 2048 for each message beside its body. Beyond, best effort of the lowest
    class is dropped first, then what does not fit, counted as `queue_full` and reported if reliable; null: no limit,
    for a relay whose clients are all trusted."""

    def rule(self) -> AccessRule:
        return AccessRule(
            client=self.client,
            publish=self.publish,
            subscribe=self.subscribe,
            replay=self.replay,
            max_bytes_per_s=self.max_bytes_per_s,
            max_rate_hz=self.max_rate_hz,
            max_queue_bytes=self.max_queue_bytes,
        )


class FeedTypeSection(Section):
    """What a topic is that programs of this role publish, so that it goes on to the clients as well."""

    match: Pattern
    """Regular expression for the whole (global) topic name; it must be among those of `publish` too."""
    type: str
    """Its message type, such as geometry_msgs/Twist: a standard one, as the definition has to be known here."""
    encoding: Literal["ros1", "cdr"] = "ros1"
    """How the programs serialise it: `ros1`, or `cdr` (ROS 2) with its four bytes of encapsulation."""
    priority: Annotated[ClassWord | None, Field(alias="class")] = None
    """Urgency, as in a client's `topics`; null: `control` for types that command a robot, else `bulk`."""
    reliability: Literal["reliable", "best_effort"] = "best_effort"
    """`reliable`: kept until delivered; `best_effort`: freshest first."""
    durability: Literal["volatile", "transient_local"] = "volatile"
    """`transient_local`: the last `depth` messages, at most 1,000, reach late joiners."""
    depth: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """Messages kept; null: 10 if reliable, else 1."""
    lifespan_s: Annotated[
        Annotated[float, Field(gt=0, le=1e7)] | Literal["auto"] | None,
        described("a number of seconds above 0, null (for ever) or auto"),
    ] = "auto"
    """Older messages, by stamp and age in their header, are not sent; null: for ever; `auto`: as for a client's topic,
    0.3 for velocity commands in class control."""

    @model_validator(mode="after")
    def _known(self) -> "FeedTypeSection":
        try:
            known = ros_types.describe(self.type, Encoding(self.encoding))
        except ConfigError as error:
            raise fault(str(error), "type") from error
        if known is None:
            raise fault(
                f"{self.type} has no definition here in {self.encoding}; standard types of ROS can be published", "type"
            )
        return self

    @property
    def commands(self) -> bool:
        """Whether it can move a robot, whatever its class."""
        return plain_type(self.type) in COMMAND_OBJECT_TYPES or self.priority == "control"

    def topic(self) -> FeedTopic:
        word = self.priority or ("control" if self.commands else "bulk")
        rule = TopicRule(
            match=compile_pattern(self.match),
            priority=PriorityClass[word.upper()],
            reliability=Reliability(self.reliability),
            durability=Durability(self.durability),
            depth=self.depth,
            lifespan_s=AUTO if self.lifespan_s == "auto" else self.lifespan_s,
        )
        return FeedTopic(rule, ros_types.canonical(self.type), Encoding(self.encoding))


class FeedRoleSection(Section):
    """One pair of sockets of the feed: whoever reaches its address has this role."""

    name: RoleText
    """The name of the role, in logs and metrics."""
    publish_endpoint: BindEndpoint
    """Where subscribers connect (the relay binds an XPUB socket)."""
    ingest_endpoint: BindEndpoint | None = None
    """Where publishers connect (the relay binds an XSUB socket); null: nobody publishes through this role."""
    subscribe: tuple[Pattern, ...] = ()
    """Patterns of the global names this role may see."""
    publish: tuple[Pattern, ...] = ()
    """Patterns of the global names this role may publish."""
    allow_control: bool = False
    """Let this role publish in class control (commands)."""
    max_rate_hz: Hertz | None = None
    """Messages a second taken through this role, of all its programs together; null: no limit."""
    max_bytes_per_s: Annotated[float, Field(gt=0, le=1e12)] | None = None
    """Bytes a second taken through this role; null: no limit."""
    types: tuple[FeedTypeSection, ...] = ()
    """What the topics are that go on to the clients, first match wins; a topic without stays within the feed."""
    insecure: bool = False
    """Accept an address beyond ipc and loopback: the feed has no keys, so the network itself must be trusted."""

    @model_validator(mode="after")
    def _consistent(self) -> "FeedRoleSection":
        for key in _SOCKETS:
            endpoint = getattr(self, key)
            if endpoint is not None and not is_local(endpoint) and not self.insecure:
                raise fault("is open to the network and the feed has no keys; insecure: true accepts that", key)
        if self.publish and self.ingest_endpoint is None:
            raise fault("is missing, and publish names topics", "ingest_endpoint")
        if self.ingest_endpoint is not None and not self.publish:
            raise fault("names no topic, so ingest_endpoint has no use", "publish")
        if self.allow_control and not self.publish:
            raise fault("has no use without publish", "allow_control")
        for key in ("types", "max_rate_hz", "max_bytes_per_s"):
            if getattr(self, key) and not self.publish:
                raise fault("has no use without publish", key)
        for index, entry in enumerate(self.types):
            if entry.commands and not self.allow_control:
                raise fault(f"{entry.type} commands a robot, which needs allow_control: true", "types", index)
        return self

    def placed(self, base_dir: Path) -> Self:
        """The same with its sockets where they are, as `FileModel.placed`."""
        found = {key: endpoint for key in _SOCKETS if (endpoint := getattr(self, key)) is not None}
        return self.model_copy(update={key: place(base_dir, endpoint) for key, endpoint in found.items()})

    def role(self) -> FeedRole:
        return FeedRole(
            name=self.name,
            publish_endpoint=self.publish_endpoint,
            ingest_endpoint=self.ingest_endpoint,
            subscribe=tuple(compile_pattern(text) for text in self.subscribe),
            publish=tuple(compile_pattern(text) for text in self.publish),
            allow_control=self.allow_control,
            types=tuple(entry.topic() for entry in self.types),
            max_rate_hz=self.max_rate_hz,
            max_bytes_per_s=self.max_bytes_per_s,
        )


class FeedSection(Section):
    """Plain ZMQ for programs on the local network, in any language. Off unless a role is given. It has no keys and
    encrypts nothing: whoever reaches an address has its role. Use it on this machine, or in a network where everybody
    is trusted."""

    roles: tuple[FeedRoleSection, ...] = ()
    """The roles; each has sockets of its own."""


class ReplaySection(Section):
    """What the relay keeps for clients that come late or come back."""

    cache_bytes: Annotated[int, Field(ge=0, le=1 << 40)] = 64 * 2**20
    """Messages of transient_local topics kept for late joiners, over all topics."""
    resume_s: Annotated[float, Field(ge=0, le=86_400)] = 600.0
    """How long the state of a client that went away is kept, so that it goes on where it was."""


class RelayFile(FileModel):
    """Configuration of the relay daemon."""

    relay: RelaySection
    """The relay itself."""
    access: tuple[AccessSection, ...] = ()
    """Who may do what, first match wins. Without rules nobody may do anything."""
    fabric: FabricSection | None = None
    """Other relays that this one forms a fabric with; null: it is alone."""
    feed: FeedSection = FeedSection()
    """Plain ZMQ for programs on the local network."""
    replay: ReplaySection = ReplaySection()
    """What is kept for clients that come late or come back."""
    durable: DurableSection | None = None
    """Where messages of durable topics are kept until all clients that subscribe to them have them; null: they are
    relayed as other reliable ones."""
    scheduler: SchedulerSection = SchedulerSection()
    """Which message each client's link carries next."""
    adaptation: AdaptationSection | None = None
    """Choose rates, queue limits and redundancy of each client's link by their predicted cost; null: leave them as they
    are. Bodies are forwarded unchanged, so `codecs` does not count here."""
    link: LinkSection = LinkSection()
    """The links to the clients."""
    http: RelayHttpSection = RelayHttpSection()
    """Metrics and health over HTTP."""
    log: LogSection = LogSection()
    """The log."""
    message_log: PathText | None = None
    """CSV file with a line for every message received and dropped; null: none. For trials: it grows without end."""
    summary: PathText | None = None
    """JSON file with the counters, written at exit; null: none."""

    @classmethod
    def foreign(cls, data: Mapping[str, Data]) -> str | None:
        needed = "a relay's is needed here (relay, access)"
        if "sern_key" in data:
            return f"is a key file; {needed}"
        if data.keys() & {"client", "endpoint"}:
            return f"is a client's file, which sern-client reads; {needed}"
        return None

    @model_validator(mode="after")
    def _addresses(self) -> "RelayFile":
        taken = {endpoint: f"relay.listen.{index}" for index, endpoint in enumerate(self.relay.listen)}
        names: set[str] = set()
        for index, role in enumerate(self.feed.roles):
            if role.name in names:
                raise fault(f"{role.name} is already the name of another role", "feed", "roles", index, "name")
            names.add(role.name)
            owners = [other.role().owner for other in self.feed.roles[:index]]
            if role.role().owner in owners:
                other = self.feed.roles[owners.index(role.role().owner)].name
                raise fault(
                    f"{role.name} and {other} are too much alike ('-' counts as '_')", "feed", "roles", index, "name"
                )
            for key in _SOCKETS:
                endpoint = getattr(role, key)
                if endpoint in taken:
                    raise fault(f"{endpoint} is already used by {taken[endpoint]}", "feed", "roles", index, key)
                if endpoint is not None:
                    taken[endpoint] = f"feed.roles.{index}.{key}"
        return self

    @property
    def name(self) -> ClientName:
        return ClientName(self.relay.name)

    def access_rules(self) -> tuple[AccessRule, ...]:
        """The rules for `sern_core.relay.access.AccessTable`, those of the feed's roles first."""
        roles = (
            AccessRule(client=role.owner, publish=tuple(pattern.pattern for pattern in role.publish))
            for role in self.feed_roles()
        )
        return (*roles, *(section.rule() for section in self.access))

    def feed_roles(self) -> tuple[FeedRole, ...]:
        return tuple(section.role() for section in self.feed.roles)

    def placed(self, base_dir: Path) -> Self:
        listen = tuple(place(base_dir, endpoint) for endpoint in self.relay.listen)
        roles = tuple(role.placed(base_dir) for role in self.feed.roles)
        return self.model_copy(
            update={
                "relay": self.relay.model_copy(update={"listen": listen}),
                "feed": self.feed.model_copy(update={"roles": roles}),
            }
        )

    def file_problems(self, base_dir: Path) -> Iterator[FileProblem]:
        for index, endpoint in enumerate(self.relay.listen):
            yield from socket_problems(base_dir, endpoint, ("relay", "listen", index))
        for index, section in enumerate(self.feed.roles):
            for key in _SOCKETS:
                yield from socket_problems(base_dir, getattr(section, key), ("feed", "roles", index, key))
        yield from self.http.problems(base_dir)
        yield from self._rule_problems()
        yield from output_problems(base_dir, self.message_log, ("message_log",))
        yield from output_problems(base_dir, self.summary, ("summary",))
        if self.durable is not None:
            yield from self.durable.problems(base_dir)
        if self.fabric is not None:
            yield from self.fabric.problems(base_dir, self.name)
        if self.relay.secret_key_file is not None:
            loc = ("relay", "secret_key_file")
            yield from secret_key_problems(base_dir, self.relay.secret_key_file, loc, owner=self.name)
        if self.relay.clients_dir is None:
            return
        loc = ("relay", "clients_dir")
        try:
            directory = KeyDirectory(resolve(base_dir, self.relay.clients_dir))
        except ConfigError as error:
            yield FileProblem(loc, str(error))
            return
        for warning in (*directory.warnings, *directory.lapsed(at_s=time.time())):
            yield FileProblem(loc, warning, warning=True)
        if not directory.names:
            yield FileProblem(loc, f"{directory.path} holds no .pub file: no client can connect", warning=True)
        for index, role in enumerate(self.feed_roles()):
            if role.owner in directory.names:
                problem = f"the relay publishes for this role as {role.owner}, and there is a client of that name"
                yield FileProblem(("feed", "roles", index, "name"), problem)
        for index, rule in enumerate(self.access):
            if directory.names and _is_name(rule.client) and rule.client not in directory.names:
                problem = f"no .pub file in {directory.path} is of {rule.client}: it cannot connect"
                yield FileProblem(("access", index, "client"), problem, warning=True)
        rules = PatternSet(section.client for section in self.access)
        for name in directory.names:
            if not rules.fullmatch(name):
                problem = f"no rule matches client {name}: it may connect and do nothing"
                yield FileProblem(("access",), problem, warning=True)

    def _rule_problems(self) -> Iterator[FileProblem]:
        """Warnings of patterns that match no name, and of commands that live too long."""
        for index, rule in enumerate(self.access):
            for word in ("publish", "subscribe", "replay"):
                yield from pattern_problems(getattr(rule, word) or (), ("access", index, word))
        for index, role in enumerate(self.feed.roles):
            at = ("feed", "roles", index)
            yield from pattern_problems(role.subscribe, (*at, "subscribe"))
            yield from pattern_problems(role.publish, (*at, "publish"))
            for number, entry in enumerate(role.types):
                yield from pattern_problem(entry.match, (*at, "types", number, "match"))
                if entry.commands:
                    place, reliable = (*at, "types", number, "lifespan_s"), entry.reliability == "reliable"
                    yield from lifespan_problem(entry.lifespan_s, place, reliable=reliable)


def _is_name(pattern: str) -> bool:
    """Whether it matches one client alone, of which the name is."""
    try:
        return client_name(pattern) == pattern
    except UsageError:
        return False


def load_relay(path: Path, *, files: bool = True) -> Loaded[RelayFile]:
    """The relay file at `path`; raises ConfigError. `files`: also check the files that it names."""
    return load(path, RelayFile, files=files)
