"""Who may publish, subscribe and ask for replays, and how much: per-client access rules, default deny.

The first rule whose `client` pattern matches a name holds for that client; nothing is merged, so exceptions go above
the general rule. A client that no rule names may do nothing.

Patterns are full-match regular expressions (patterns.py). In a topic pattern `{self}` stands for the client's own name,
literally: `/{self}/.*` grants `jackal1` what is under `/jackal1/` and nothing of `jackal10`.

What was kept of a topic follows the topic's own rules (`sern_core.topics.spool_names`): who may publish it may keep it,
who may subscribe to it and have its earlier messages may fetch them.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from sern_core.topics import spool_names
from sern_core.topics.patterns import PatternError, PatternSet, compile_pattern
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.names import NAME_MAX_CHARS
from sern_core.vocabulary.types import ClientName, TopicName

SELF: Final = "{self}"
"""Placeholder for the client's own name in topic patterns."""
_SELF: Final = re.compile(r"\{self\}(?=([?*+{])?)")
LONGEST_NAME: Final = "x" * 63
"""A rule that can be compiled for this client can be for any."""
CACHE_ENTRIES: Final = 65_536
"""Decisions remembered in all; when full the cache is emptied, so that invented names cannot grow it."""
CLIENT_ENTRIES: Final = 4_096
"""Clients whose compiled patterns are remembered; clients are bounded by the key directory anyway."""
DEFAULT_QUEUE_BYTES: Final = 128 * 2**20
"""What may wait for one client at the relay: four reliable topics that are full at their origins."""
DEFAULT_BURST_S: Final = 1.0
"""Seconds of its rate that a client may use at once."""


class Right(StrEnum):
    """What a rule grants."""

    PUBLISH = "publish"
    SUBSCRIBE = "subscribe"
    REPLAY = "replay"


@dataclass(frozen=True, slots=True)
class AccessRule:
    """Grants for the clients whose name `client` matches (full match).

    `replay` None follows `subscribe`; a replay always needs `subscribe` as well. A limit None is no limit.
    """

    client: str
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    replay: tuple[str, ...] | None = None
    max_bytes_per_s: float | None = None
    max_rate_hz: float | None = None
    max_queue_bytes: int | None = DEFAULT_QUEUE_BYTES


ASKING: Final = ("/take", "/release")
"""Topics below a command or an e-stop, on which it is asked to hold or to release it."""
HOLDER: Final = "/holder"
"""The topic below a command on which its robot says who holds it."""


class ClientLimits(NamedTuple):
    """Limits of one client; None: unlimited."""

    max_bytes_per_s: float | None = None
    max_rate_hz: float | None = None
    max_queue_bytes: int | None = DEFAULT_QUEUE_BYTES


class LostAccess(NamedTuple):
    """A right that a reload took away."""

    client: ClientName
    topic: TopicName
    right: Right


class AccessReload(NamedTuple):
    """The table after a reload and what it took away; swap the table in, then act on `lost`."""

    table: "AccessTable"
    lost: tuple[LostAccess, ...]


class _Grants(NamedTuple):
    """The patterns of one client, compiled, and its limits."""

    limits: ClientLimits
    publish: PatternSet
    subscribe: PatternSet
    replay: PatternSet


_NOTHING: Final = _Grants(ClientLimits(), PatternSet(()), PatternSet(()), PatternSet(()))


class AccessTable:
    """Decides by (client, topic). Immutable apart from its cache: a reload makes a new one with `replaced`.

    Raises ConfigError that names a bad pattern or limit and its key, `access[2].publish[0]`.
    """

    __slots__ = ("_cache", "_client_patterns", "_grants", "_rules")

    def __init__(self, rules: Iterable[AccessRule] = ()) -> None:
        self._rules = tuple(rules)
        self._client_patterns = tuple(_checked(rule, index) for index, rule in enumerate(self._rules))
        self._grants: dict[ClientName, _Grants] = {}
        self._cache: dict[tuple[Right, ClientName, TopicName], bool] = {}

    @property
    def rules(self) -> tuple[AccessRule, ...]:
        return self._rules

    def may_publish(self, client: ClientName, topic: TopicName) -> bool:
        return self.allows(Right.PUBLISH, client, topic)

    def may_subscribe(self, client: ClientName, topic: TopicName) -> bool:
        return self.allows(Right.SUBSCRIBE, client, topic)

    def may_replay(self, client: ClientName, topic: TopicName) -> bool:
        """Whether the client may be sent this topic's earlier messages (late joiner, backfill)."""
        return self.allows(Right.REPLAY, client, topic)

    def allows(self, right: Right, client: ClientName, topic: TopicName) -> bool:
        key = (right, client, topic)
        known = self._cache.get(key)
        if known is not None:
            return known
        if len(self._cache) >= CACHE_ENTRIES:
            self._cache.clear()
        allowed = self._decide(right, client, topic)
        self._cache[key] = allowed
        return allowed

    def limits(self, client: ClientName) -> ClientLimits:
        """The limits of the client's rule; no limits for a client without one, which may do nothing anyway."""
        return self._granted(client).limits

    def replaced(self, rules: Iterable[AccessRule], pairs: Iterable[tuple[ClientName, TopicName]] = ()) -> AccessReload:
        """A table of the new rules, and which rights over `pairs` it no longer gives; this one stays as it is.

        `pairs` are the (client, topic) pairs in use: the cache is bounded, so the table cannot know them itself.
        Raises ConfigError for bad rules; then the old table stays in force.
        """
        table = AccessTable(rules)
        lost = tuple(
            LostAccess(client, topic, right)
            for client, topic in dict.fromkeys(pairs)
            for right in Right
            if self.allows(right, client, topic) and not table.allows(right, client, topic)
        )
        return AccessReload(table, lost)

    def _decide(self, right: Right, client: ClientName, topic: TopicName) -> bool:
        if len(topic) > NAME_MAX_CHARS:
            return False
        granted = self._granted(client)
        kept = spool_names.parse(topic)
        if kept is not None:
            return _may_fetch(granted, right, client, kept)
        if right is Right.PUBLISH:
            return granted.publish.fullmatch(topic) or self._asks(granted, topic)
        if not granted.subscribe.fullmatch(topic):
            if topic.endswith(HOLDER) and granted.publish.fullmatch(topic.removesuffix(HOLDER)):
                return True  # who may publish the commands is told who holds them
            return right is Right.SUBSCRIBE and self._is_asked(granted, topic)
        return right is Right.SUBSCRIBE or granted.replay.fullmatch(topic)

    def _asks(self, granted: _Grants, topic: TopicName) -> bool:
        """Who may publish a command may ask to hold it, and who may publish an e-stop may ask to release it."""
        return any(granted.publish.fullmatch(topic.removesuffix(word)) for word in ASKING if topic.endswith(word))

    def _is_asked(self, granted: _Grants, topic: TopicName) -> bool:
        """Who gets the commands gets what is asked of them."""
        return any(granted.subscribe.fullmatch(topic.removesuffix(word)) for word in ASKING if topic.endswith(word))

    def _granted(self, client: ClientName) -> _Grants:
        granted = self._grants.get(client)
        if granted is None:
            if len(self._grants) >= CLIENT_ENTRIES:
                self._grants.clear()
            granted = self._compiled(client)
            self._grants[client] = granted
        return granted

    def _compiled(self, client: ClientName) -> _Grants:
        if len(client) > len(LONGEST_NAME) or not (client.isascii() and client.isprintable()):
            return _NOTHING  # no client has such a name
        for rule, pattern in zip(self._rules, self._client_patterns, strict=True):
            if pattern.fullmatch(client):
                return _Grants(
                    ClientLimits(rule.max_bytes_per_s, rule.max_rate_hz, rule.max_queue_bytes),
                    _for_client(rule.publish, client),
                    _for_client(rule.subscribe, client),
                    _for_client(rule.subscribe if rule.replay is None else rule.replay, client),
                )
        return _NOTHING


class RateGuard:
    """Token buckets for one client's messages and bytes per second; None means no limit.

    A message is admitted when its tokens are there. One that is larger than the whole bucket is admitted from a full
    bucket and leaves a debt, so that it is slowed to the rate and not refused for ever. Over any T seconds at most
    `rate·(T + burst_s)` plus one message passes.
    """

    __slots__ = ("_bytes", "_bytes_full", "_bytes_per_s", "_messages", "_messages_full", "_rate_hz", "_updated_s")

    def __init__(
        self,
        *,
        now: float,
        max_bytes_per_s: float | None = None,
        max_rate_hz: float | None = None,
        burst_s: float = DEFAULT_BURST_S,
    ) -> None:
        for name, rate in (("max_bytes_per_s", max_bytes_per_s), ("max_rate_hz", max_rate_hz), ("burst_s", burst_s)):
            if rate is not None and not (rate > 0 and math.isfinite(rate)):
                raise UsageError(f"RateGuard: {name} is {rate}; give a positive number or None")
        self._bytes_per_s = math.inf if max_bytes_per_s is None else max_bytes_per_s
        self._rate_hz = math.inf if max_rate_hz is None else max_rate_hz
        self._bytes_full = self._bytes_per_s * burst_s
        # Fewer than one message in the bucket would let none through.
        self._messages_full = max(1.0, self._rate_hz * burst_s)
        self._bytes = self._bytes_full
        self._messages = self._messages_full
        self._updated_s = now

    @classmethod
    def of(cls, limits: ClientLimits, *, now: float) -> "RateGuard":
        return cls(max_bytes_per_s=limits.max_bytes_per_s, max_rate_hz=limits.max_rate_hz, now=now)

    def holds(self, limits: ClientLimits) -> bool:
        """Whether these are its rates."""
        rates = (limits.max_bytes_per_s, limits.max_rate_hz)
        return tuple(math.inf if rate is None else rate for rate in rates) == (self._bytes_per_s, self._rate_hz)

    def full(self, now: float) -> bool:
        """Whether it is as good as a new one."""
        return self._filled(now) == (self._messages_full, self._bytes_full)

    def admit(self, size_bytes: int, *, now: float) -> bool:
        """Take the tokens of one message, or take none and say no."""
        messages, tokens_bytes = self._filled(now)
        if messages < 1.0 or tokens_bytes < min(size_bytes, self._bytes_full):
            return False
        self._messages = messages - 1.0
        self._bytes = tokens_bytes - size_bytes
        self._updated_s = max(now, self._updated_s)
        return True

    def ready_in_s(self, size_bytes: int, *, now: float) -> float:
        """Seconds until a message of this size would be admitted; 0 when it would be now."""
        messages, tokens_bytes = self._filled(now)
        missing_s = max(0.0, 1.0 - messages) / self._rate_hz
        if math.isfinite(self._bytes_per_s):
            missing_s = max(missing_s, (min(size_bytes, self._bytes_full) - tokens_bytes) / self._bytes_per_s)
        return missing_s

    def _filled(self, now: float) -> tuple[float, float]:
        """Tokens at `now`: messages and bytes. A clock that runs backwards earns nothing."""
        elapsed_s = now - self._updated_s
        if elapsed_s <= 0.0:
            return self._messages, self._bytes
        return (
            min(self._messages_full, self._messages + elapsed_s * self._rate_hz),
            min(self._bytes_full, self._bytes + elapsed_s * self._bytes_per_s),
        )


def _may_fetch(granted: _Grants, right: Right, client: ClientName, kept: spool_names.SpoolStream) -> bool:
    """Who has which part in a stream of what was kept of a topic. Requests go the other way."""
    sends = right is Right.PUBLISH
    if sends is not (kept.kind is spool_names.SpoolStreamKind.FETCH):
        return granted.publish.fullmatch(kept.topic)
    its_own = kept.kind is spool_names.SpoolStreamKind.KEPT or kept.site == client
    return its_own and granted.subscribe.fullmatch(kept.topic) and granted.replay.fullmatch(kept.topic)


def with_self(text: str, client: str) -> str:
    """The pattern with the client's own name in place of `{self}`, in a group where a repeat follows: `{self}?` means
    the whole name."""
    name = re.escape(client)
    return _SELF.sub(lambda found: f"(?:{name})" if found[1] else name, text) if SELF in text else text


def _for_client(texts: tuple[str, ...], client: ClientName) -> PatternSet:
    return PatternSet(with_self(text, client) for text in texts)


def _checked(rule: AccessRule, index: int) -> PatternSet:
    """Compile every pattern of a rule once, so that a bad one is found before the rule is in force."""
    where = f"access[{index}]"
    for right, texts in ((Right.PUBLISH, rule.publish), (Right.SUBSCRIBE, rule.subscribe), (Right.REPLAY, rule.replay)):
        for position, text in enumerate(texts or ()):
            _compile_rule(with_self(text, LONGEST_NAME), text, f"{where}.{right}[{position}]")
    limits = ClientLimits(rule.max_bytes_per_s, rule.max_rate_hz, rule.max_queue_bytes)
    for name, limit in limits._asdict().items():
        if limit is not None and not (limit > 0 and math.isfinite(limit)):
            raise ConfigError(f"{limit} is not a limit; give a positive number or leave it out", key=f"{where}.{name}")
    return _compile_rule(rule.client, rule.client, f"{where}.client")


def _compile_rule(pattern: str, text: str, key: str) -> PatternSet:
    try:
        return compile_pattern(pattern)
    except PatternError as error:
        raise ConfigError(f"pattern {text!r} {error}", key=key) from None
