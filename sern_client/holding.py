"""Who commands which robot: kept at the robot (`sern_core/site/hold.py`), told to every operator, asked for by them.

Below a command topic there are two more: on `/take` operators ask, on `/holder` the robot says who holds it, latched.
An operator's client that hears that another one holds the topic sends no command of its own: they are dropped here for
`not_holder`, until it holds the topic itself. Where it has not heard yet the robot refuses them.
"""

import asyncio
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

from sern_client.asking import SPEC, TEXT_TYPE, Asking
from sern_client.endpoints.base import Sink
from sern_client.site import Site
from sern_core.site.client import ClientCore
from sern_core.site.hold import Hold
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import SernError, UsageError
from sern_core.vocabulary.ledger import MAX_TOPICS
from sern_core.vocabulary.types import ClientName, DropReason, Durability, Encoding, TopicName
from sern_runtime import clock, ros_types

TAKE: Final = "/take"
HOLDER: Final = "/holder"
ASK_WAIT_S: Final = 15.0
"""Longest wait for the holder to give what was asked for."""
FORCE_WAIT_S: Final = 5.0
POLL_S: Final = 0.05
WORDS: Final = ("ask", "force", "give")

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Held:
    """A command topic of this robot."""

    hold: Hold
    name: TopicName  # global
    channel: OutChannel | None = None
    told: int = -1
    holder: ClientName | None = None


@dataclass(frozen=True, slots=True)
class Told:
    """What a robot says of a command topic."""

    holder: ClientName | None
    asked: tuple[str, ...]
    lapse_s: float


class Holding:
    """Both sides of one client: command topics of its own robot (`keep`), and those that it sends (`follow`).

    `subscribe` is told which topics are wanted for this. Call `look` about twice a second."""

    def __init__(
        self, site: Site, core: ClientCore, asking: Asking, subscribe: Callable[[tuple[TopicName, ...]], None]
    ) -> None:
        self._site = site
        self._core = core
        self._asking = asking
        self._subscribe = subscribe
        self._kept: dict[TopicName, _Held] = {}  # by local name
        self._told: dict[TopicName, Told | None] = {}  # by global name
        self._refused: set[TopicName] = set()  # of those: a command from here was not sent

    # --- at the robot -----------------------------------------------------------------------------------------------

    def keep(self, local: TopicName, name: TopicName, lapse_s: float) -> None:
        """Have one operator at a time command a topic of this site, `name` elsewhere."""
        self._kept[local] = _Held(Hold(lapse_s), name)
        self._asking.listen(TopicName(f"{name}{TAKE}"), partial(self._asked, local))

    def obeys(self, local: TopicName, who: ClientName, *, now: float) -> bool:
        """Whether a command of somebody is obeyed."""
        held = self._kept.get(local)
        if held is None:
            return True
        obeyed = held.hold.command(who, now=now)
        self._tell(held)
        return obeyed

    def ended(self, local: TopicName, who: ClientName) -> None:
        held = self._kept.get(local)
        if held is not None:
            held.hold.ended(who)

    def _asked(self, local: TopicName, who: ClientName, word: str) -> None:
        held, now = self._kept[local], clock.now()
        if word not in WORDS:
            raise UsageError(f"{word[:40]!r} is none of {', '.join(WORDS)}")
        if word == "ask":
            held.hold.ask(who, now=now)
        elif word == "force":
            held.hold.force(who, now=now)
        else:
            held.hold.give(who, now=now)
        self._tell(held)

    def look(self) -> None:
        """Let go of what has lapsed, and tell."""
        for held in self._kept.values():
            held.hold.look(now=clock.now())
            self._tell(held)

    def _tell(self, held: _Held) -> None:
        """Tell every operator, and whoever follows this robot, what has changed."""
        hold = held.hold
        if hold.changes == held.told:
            return
        held.told = hold.changes
        if held.channel is None:
            info = ros_types.topic_info(f"{held.name}{HOLDER}", TEXT_TYPE, Encoding.CDR, latched=True)
            kind = replace(SPEC, durability=Durability.TRANSIENT_LOCAL, depth=1, lifespan_s=None, many_writers=False)
            held.channel = self._core.publish(info, replace(kind, retention_s=60.0), now=clock.now())
        said = {"holder": hold.holder, "asked": list(hold.asked), "lapse_s": hold.lapse_s}
        text = ros_types.new(TEXT_TYPE, Encoding.CDR, data=json.dumps(said))
        self._core.send(held.channel, ros_types.serialise(text, TEXT_TYPE, Encoding.CDR), 0, now=clock.now())
        self._site.kick()
        if hold.holder != held.holder:
            self._say(held.name, held.holder, hold.holder)
            held.holder = hold.holder

    def _say(self, name: TopicName, before: ClientName | None, now: ClientName | None) -> None:
        by = "nobody" if now is None else now
        was = "" if before is None else f", before by {before}"
        self._site.events.say(_log, logging.WARNING, "holder", name, "%s: held by %s%s", name, by, was)

    # --- at an operator ---------------------------------------------------------------------------------------------

    def _follow(self, name: TopicName) -> None:
        """This site sends commands on a topic (global name): be told who holds it."""
        self._refused.discard(name)  # who begins anew may hold it by commanding
        if name in self._told or len(self._told) >= MAX_TOPICS:
            return
        self._told[name] = None
        self._asking.listen(TopicName(f"{name}{HOLDER}"), partial(self._hear, name))
        self._subscribe(self._asking.topics)

    def sink(self, channel: OutChannel, inner: Sink) -> Sink:
        """What takes commands from here in place of `inner`: none goes on while another operator holds the topic."""
        name = channel.stream.id.topic
        self._follow(name)

        def withheld(body: bytes, stamp_ns: int) -> bool:
            if self.withholds(name):
                self._core.drop(channel, len(body), DropReason.NOT_HOLDER, now=clock.now())
                return True
            return inner(body, stamp_ns)

        return withheld

    def withholds(self, name: TopicName) -> bool:
        """Whether a command from here is not sent: another operator holds the topic, or did and nobody does now."""
        told = self._told.get(name)
        if told is None or told.holder == self._core.name:
            self._refused.discard(name)
            return False
        if told.holder is not None and name not in self._refused:
            self._refused.add(name)
            words = "%s: %s holds it, and commands from here are not sent; `sern take %s` asks for it"
            self._site.events.say(_log, logging.WARNING, "not_holder", name, words, name, told.holder, name)
        return name in self._refused

    def _hear(self, name: TopicName, _who: ClientName, text: str) -> None:
        try:
            said = json.loads(text)
            holder = said["holder"]
            told = Told(
                None if holder is None else ClientName(str(holder)),
                tuple(str(who) for who in said["asked"]),
                float(said["lapse_s"]),
            )
        except (ValueError, TypeError, KeyError) as error:
            raise UsageError(f"it does not say who holds {name}") from error
        before, self._told[name] = self._told[name], told
        was = None if before is None else before.holder
        if before is None or told.holder != was:
            self._say(name, was, told.holder)
        if told.holder == self._core.name:
            for who in told.asked:
                if before is None or who not in before.asked:
                    words = "%s: %s asks to take it; `sern take %s --give` gives it"
                    self._site.events.say(_log, logging.WARNING, "asked", name, words, name, who, name)

    def to_json(self) -> dict[str, Any]:
        """Who holds what, as far as this site knows."""
        rows: dict[str, Any] = {}
        for name, told in self._told.items():
            if told is not None:
                rows[name] = {"holder": told.holder, "asked": list(told.asked)}
        for held in self._kept.values():
            rows[held.name] = {"holder": held.hold.holder, "asked": list(held.hold.asked)}
        return rows

    async def take(self, name: TopicName, word: str) -> dict[str, Any]:
        """Ask for a topic, take it by force, or give it. Returns who held it, and who does. Raises SernError."""
        told = self._told.get(name)
        if told is None:
            hint = "has it a rule with `holder` here and at its robot, is it published here, and is its robot there?"
            raise SernError(f"nothing is known of who holds {name}: {hint}")
        me = self._core.name
        if word == "give" and told.holder != me:
            raise UsageError(f"{name} is not yours to give: {told.holder or 'nobody'} holds it")
        if word != "give" and told.holder == me:
            return {"before": me, "holder": me}
        await self._asking.ask(TopicName(f"{name}{TAKE}"), word)
        give_up_s = clock.now() + (ASK_WAIT_S if word == "ask" else FORCE_WAIT_S)
        while (now := self._told[name]) is not None and (now.holder == me) == (word == "give"):
            if clock.now() >= give_up_s:
                if word == "ask":
                    raise SernError(f"{now.holder or 'nobody'} holds {name} and has not given it; --force takes it")
                raise SernError(f"{name}: the robot was told, and has not said that it changed; see `sern events`")
            await asyncio.sleep(POLL_S)
        return {"before": told.holder, "holder": None if now is None else now.holder}
