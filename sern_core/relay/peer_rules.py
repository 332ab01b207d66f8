"""The access rules of several relays: each knows its peers' where they are not its own. Pure.

Relays tell each other the hash of their rules when a session begins and when a reload has changed them, and the rules
themselves where the hashes differ. What they are for is in `peer_rights`. What a peer has said last holds until it says
something else.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, fields
from functools import partial
from typing import Any, Final

from sern_core.link.link import Link
from sern_core.relay.access import AccessRule, AccessTable
from sern_core.relay.clients import Clients
from sern_core.relay.hub_events import GuardedEvents
from sern_core.relay.peer_rights import PeerRights
from sern_core.topics.patterns import PATTERN_MAX_CHARS
from sern_core.vocabulary.errors import ConfigError, WireError
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing

HASH_DIGITS: Final = 32
MAX_RULES: Final = 2048
MAX_PATTERNS: Final = 16_384
MAX_TEXT_BYTES: Final = framing.MAX_ATTACHMENT_BYTES
"""What of a relay's rules can be told to another: rules, patterns in them, and bytes of their text."""
PATTERN_US: Final = 30
"""What a peer is charged with, in microseconds, for each pattern of its rules: it is compiled."""
MAX_LIMIT: Final = 2.0**62
_PATTERNS: Final = ("publish", "subscribe", "replay")
_NUMBERS: Final = ("max_bytes_per_s", "max_rate_hz", "max_queue_bytes")


class RulesExchange:
    """Tells peers our rules, and hears theirs. `judge` is called when what a peer grants has changed. `reached` gives
    the links of the peers with a session.

    Rules are told whole unless the process at the other end has said that it has the same: before anything is announced
    in a session, so that a relay that is started anew knows whom it may hold a stream for.
    """

    def __init__(
        self,
        rules: Sequence[AccessRule],
        clients: Clients,
        rights: PeerRights,
        events: GuardedEvents,
        *,
        reached: Callable[[], Iterator[Link]],
        judge: Callable[[ClientName, float], None],
    ) -> None:
        self._clients = clients
        self._rights = rights
        self._events = events
        self._reached = reached
        self._judge = judge
        self._heard: dict[ClientName, tuple[str, int | None]] = {}  # the hash of a peer's rules, and of which process
        self._told: set[ClientName] = set()  # peers that were told our rules whole in their session
        self._compared: dict[ClientName, bool] = {}
        self._rules = tuple(rules)
        self._text = rules_text(rules)
        self.hash = rules_hash(self._text)
        self._problem = _too_much(rules, self._text)

    def differ(self, peer: ClientName) -> bool | None:
        """Whether a peer has other rules than we; None: it has not said yet."""
        same = self._compared.get(peer)
        return None if same is None else not same

    def use(self, rules: Sequence[AccessRule], *, now: float) -> None:
        """Our rules are these from now on."""
        text = rules_text(rules)
        if text == self._text:
            return
        before, self._rules = self._rules, tuple(rules)
        self._text, self.hash, self._problem = text, rules_hash(text), _too_much(rules, text)
        self._told.clear()
        for link in self._reached():
            self._tell(link, now)
        for peer, same in list(self._compared.items()):
            if self._heard[peer][0] == self.hash:
                self._same(peer, now)
            elif same:  # it still has what we had
                self._rights.rules[peer] = AccessTable(before)
                self._judge(peer, now)
                self._compare(peer, same=False)

    def up(self, link: Link, *, now: float) -> None:
        """The session with a peer has begun. What it said last holds until it says something else."""
        self._told.discard(link.peer)
        self._tell(link, now)

    def lost(self, peer: ClientName) -> None:
        """It has stayed away for too long."""
        self._heard.pop(peer, None)
        self._told.discard(peer)
        self._compared.pop(peer, None)
        self._rights.lost(peer)

    def told(self, link: Link, envelope: framing.Envelope, attachment: bytes, *, now: float) -> None:
        """A peer says which rules it has. Raises WireError."""
        peer, said = link.peer, framing.take_str(envelope, "hash", max_length=64)
        if attachment and rules_hash(attachment) != said:
            raise WireError("rules with another hash than theirs")
        known = self._rights.rules.get(peer)
        have = "" if known is None else rules_hash(rules_text(known.rules))
        if said == self.hash:
            self._heard[peer] = (said, link.end.peer_boot)
            self._same(peer, now)
            return
        if have != said:
            self._take(link, attachment, now)
        self._heard[peer] = (said, link.end.peer_boot)
        self._compare(peer, same=False)
        if peer not in self._told:
            self._tell(link, now)

    def _same(self, peer: ClientName, now: float) -> None:
        if peer in self._rights.rules:
            del self._rights.rules[peer]
            self._judge(peer, now)
        self._compare(peer, same=True)

    def _take(self, link: Link, text: bytes, now: float) -> None:
        """A peer has these rules; empty: it does not say."""
        peer = link.peer
        rules = parse_rules(text) if text else None
        table: AccessTable | None = None
        try:
            if rules is None:
                raise ConfigError("they say more than this release knows" if text else "it does not tell them")
            link.reassembly.work_us += PATTERN_US * _patterns(rules)
            table = AccessTable(rules)
        except ConfigError as error:
            what = f"the access rules of the relay {peer[1:]} cannot be used: {error}; none of its topics is taken"
            self._events.refused(peer, "bad_rules", what)
        self._rights.rules[peer] = table
        self._judge(peer, now)

    def _tell(self, link: Link, now: float) -> None:
        peer, text = link.peer, b""
        if self._heard.get(peer) != (self.hash, link.end.peer_boot):
            self._told.add(peer)
            if self._problem:
                self._events.refused(peer, "too_many_rules", self._problem)
            else:
                text = self._text
        said: framing.Envelope = {"t": "rules", "hash": self.hash}
        self._clients.attempt(peer, now, partial(link.control.send, said, text, now=now))

    def _compare(self, peer: ClientName, *, same: bool) -> None:
        before = self._compared.get(peer)
        self._compared[peer] = same
        if before != same and not (before is None and same):  # that they are alike is no news at first
            self._events.rules_compared(peer, same=same)


def rules_text(rules: Sequence[AccessRule]) -> bytes:
    """Rules as one relay tells them to another: the same bytes for rules that grant the same in the same words."""
    return json.dumps([asdict(rule) for rule in rules], sort_keys=True, separators=(",", ":")).encode()


def rules_hash(text: bytes) -> str:
    """The hash by which relays compare their `rules_text`."""
    return hashlib.sha256(text).hexdigest()[:HASH_DIGITS]


def parse_rules(text: bytes) -> tuple[AccessRule, ...] | None:
    """The rules of `rules_text`; None: they say something that this release does not know. Raises WireError."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        raise WireError("rules that are no JSON") from None
    if not isinstance(content, list) or len(content) > MAX_RULES:
        raise WireError(f"rules that are no list of at most {MAX_RULES}")
    known = {field.name for field in fields(AccessRule)}
    if not all(isinstance(item, dict) for item in content):
        raise WireError("rules with something that is no rule")
    if any(set(item) != known for item in content):
        return None
    rules = tuple(map(_rule, content))
    if _patterns(rules) > MAX_PATTERNS:
        raise WireError(f"rules with more than {MAX_PATTERNS} patterns")
    return rules


def _rule(item: dict[str, Any]) -> AccessRule:
    texts: dict[str, tuple[str, ...] | None] = {}
    for name in _PATTERNS:
        value = item[name]
        if value is None and name == "replay":
            texts[name] = None
        elif isinstance(value, list) and all(map(_is_pattern, value)):
            texts[name] = tuple(value)
        else:
            raise WireError(f"a rule whose {name} are no patterns")
    for name in _NUMBERS:
        value = item[name]
        if value is not None and not (type(value) in (int, float) and 0 < value < MAX_LIMIT):
            raise WireError(f"a rule whose {name} is no limit")
    if not _is_pattern(item["client"]):
        raise WireError("a rule without a client")
    return AccessRule(
        client=item["client"],
        publish=texts["publish"] or (),
        subscribe=texts["subscribe"] or (),
        replay=texts["replay"],
        max_bytes_per_s=item["max_bytes_per_s"],
        max_rate_hz=item["max_rate_hz"],
        max_queue_bytes=item["max_queue_bytes"],
    )


def _is_pattern(value: object) -> bool:
    return isinstance(value, str) and len(value) <= PATTERN_MAX_CHARS


def _patterns(rules: Sequence[AccessRule]) -> int:
    return sum(1 + len(rule.publish) + len(rule.subscribe) + len(rule.replay or ()) for rule in rules)


def _too_much(rules: Sequence[AccessRule], text: bytes) -> str:
    """Why these rules cannot be told to another relay; empty: they can."""
    if len(rules) <= MAX_RULES and _patterns(rules) <= MAX_PATTERNS and len(text) <= MAX_TEXT_BYTES:
        return ""
    return (
        f"the access rules are too many to tell them to other relays: {len(rules)} rules with {_patterns(rules)} "
        f"patterns, {len(text)} bytes; give all relays the same, or use {{self}} and fewer of them"
    )
