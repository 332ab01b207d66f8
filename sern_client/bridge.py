"""Joins an endpoint to the client core: hands the core's news to whoever it concerns."""

import logging
from collections.abc import Callable
from functools import partial
from typing import Protocol

from sern_client.actions import GoalWatch
from sern_client.asking import Asking
from sern_client.durable import DurableTopics
from sern_client.endpoints.common.saying import SayOnce
from sern_client.guard import Guard
from sern_client.holding import Holding
from sern_client.inbound import Inbound
from sern_client.outbound import Outbound
from sern_client.services import ServiceBridge
from sern_client.site import Site
from sern_client.spool.spool import Spool
from sern_core.link.handshake import DISPLACED
from sern_core.site.client import ClientCore
from sern_core.site.client_events import ClientEvents
from sern_core.site.services import parse as parse_service
from sern_core.topics.rules import Discovery, RuleSet
from sern_core.topics.spool_names import parse as parse_spooled
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.key_news import RelayKeys
from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import DropReason
from sern_core.wire import framing

_log = logging.getLogger(__name__)


class Shell(Protocol):
    """Is told what becomes of the link itself."""

    def link_up(self) -> None: ...

    def link_down(self, reason: str) -> None: ...

    def lane_offered(self, parameters: framing.Envelope) -> None: ...

    def lane_closed(self) -> None: ...

    def keys_told(self, keys: RelayKeys) -> None: ...

    def fault(self, error: Exception) -> None: ...


class Bridge:
    """`ClientEvents` of the core that `make_core` makes. `outbound` is told by the endpoint which topics there are.

    `make_services` is given where there are rules for services, `goals` where there are rules for actions of ROS 1,
    `make_durable` where there is a place for durable topics, `make_spool` where messages are kept or fetched.
    """

    def __init__(
        self,
        site: Site,
        make_core: Callable[[ClientEvents], ClientCore],
        discovery: Discovery,
        shell: Shell,
        *,
        make_services: Callable[[ClientCore], ServiceBridge] | None = None,
        guard: Guard | None = None,
        goals: GoalWatch | None = None,
        make_durable: Callable[[ClientCore], DurableTopics] | None = None,
        make_spool: Callable[[ClientCore], Spool] | None = None,
        withdraws: bool = False,
    ) -> None:
        self._shell = shell
        self.site = site
        self.core = make_core(self)
        self.durable = None if make_durable is None else make_durable(self.core)
        self.spool = None if make_spool is None else make_spool(self.core)
        taps, fetching = (None, None) if self.spool is None else (self.spool.taps, self.spool.fetching)
        self.outbound = Outbound(site, self.core, discovery, goals=goals, durable=self.durable, taps=taps)
        self.inbound = Inbound(site, self.core, guard=guard, goals=goals, withdraws=withdraws, fetching=fetching)
        self.asking = Asking(site, self.core, self.outbound.refused.get)
        """Requests of other clients, and to them."""
        self.holding = Holding(site, self.core, self.asking, partial(self.inbound.subscribed.add, "asking"))
        """Who commands which robot."""
        self.inbound.elsewhere = self.asking.takes
        self.outbound.holding = self.inbound.commands.holding = self.holding
        self.goals = goals
        self.services = None if make_services is None else make_services(self.core)
        self._said = SayOnce(_log)
        self.rejected_reason: str | None = None
        """Why the relay refuses us, in its words; None: it does not."""

    def use(self, rules: RuleSet, discovery: Discovery) -> None:
        """Have other rules in force, at once: nothing that they say the same of is touched."""
        self.outbound.use(rules, discovery)
        self.inbound.rules_changed()

    def close(self) -> None:
        """Call this before the endpoint is stopped: it tells a robot that is being commanded to stand still."""
        self.outbound.close()
        if self.goals is not None:
            self.goals.close()
        self.inbound.close()
        if self.durable is not None:
            self.durable.close()

    # --- ClientEvents: of the link ----------------------------------------------------------------------------------

    def link_up(self, *, resumed: bool) -> None:
        self.rejected_reason = None
        self.outbound.refused.clear()  # everything is announced anew
        _log.info("connected to %s%s", self.core.link.peer, " again" if resumed else "")
        self._shell.link_up()

    def link_down(self, reason: str) -> None:
        self._shell.link_down(reason)

    def rejected(self, code: str, text: str) -> None:
        # It is asked again every few seconds; of a session that was taken from us `link_down` has said it.
        if text != self.rejected_reason:
            peer = self.core.link.peer
            if code == DISPLACED:
                self.site.events.add("takeover", peer, text, code=code)
            else:
                words = "the relay refuses us (%s): %s"
                self.site.events.say(_log, logging.ERROR, "refused", peer, words, code, text, code=code)
        self.rejected_reason = text

    def lane_offered(self, parameters: framing.Envelope) -> None:
        self._shell.lane_offered(parameters)

    def lane_closed(self) -> None:
        self._shell.lane_closed()

    def keys_told(self, keys: RelayKeys) -> None:
        self._shell.keys_told(keys)

    def fault(self, error: Exception) -> None:
        self._shell.fault(error)

    # --- of streams from elsewhere ----------------------------------------------------------------------------------

    def stream_opened(self, stream: StreamInfo) -> None:
        spooled = parse_spooled(stream.id.topic)
        if spooled is not None:
            if self.spool is None:
                raise ConfigError(f"{stream.id.topic} is of what was kept of a topic; no `spool` here")
            self.spool.stream_opened(stream, spooled)
        elif self.asking.takes(stream.id.topic):
            self.asking.opened(stream)
        elif parse_service(stream.id.topic) is None:
            self.inbound.stream_opened(stream)
        elif self.services is not None:
            self.services.stream_opened(stream)
        else:
            raise ConfigError(f"{stream.id.topic} is of a service; nothing in `services` here")

    def stream_closed(self, stream: StreamInfo) -> None:
        if self.services is not None:
            self.services.stream_closed(stream)
        if self.spool is not None:
            self.spool.stream_closed(stream)
        self.inbound.stream_closed(stream)

    def message(self, stream: StreamInfo, message: Message, *, now: float) -> DropReason | None:
        if stream.id in self.inbound.streams:
            return self.inbound.message(stream, message, now=now)
        if self.spool is not None and self.spool.message(stream, message):
            return None
        if self.asking.takes(stream.id.topic):
            self.asking.message(stream, message)
        elif self.services is not None:
            self.services.message(stream, message)
        return None

    def expired(self, stream: StreamInfo, seq: int, reason: DropReason) -> None:
        if self.spool is not None:
            self.spool.expired(stream)
        self.inbound.expired(stream, seq, reason)

    def skipped(self, stream: StreamInfo, count: int) -> None:
        if self.spool is not None:
            self.spool.expired(stream)
        self.inbound.skipped(stream, count)

    def undecodable(self, stream: StreamInfo, problem: str) -> None:
        self.inbound.undecodable(stream, problem)

    def object_refused(self, object_id: str, code: str, why: str) -> None:
        self._said(f"the relay does not take the object {object_id} ({code}): {why}", code)

    def subscription_refused(self, code: str, text: str) -> None:
        self.inbound.subscription_refused(code, text)

    # --- of our own streams -----------------------------------------------------------------------------------------

    def wanted(self, stream: StreamInfo, wanted: bool) -> None:
        self.outbound.wanted(stream, wanted)

    def send_dropped(self, stream: StreamInfo, first: int, count: int, reason: DropReason, where: str) -> None:
        if self.services is not None:
            self.services.send_dropped(stream, first, count, reason)
        self.outbound.send_dropped(stream, first, count, reason, where)

    def publication_refused(self, stream: StreamInfo, code: str, text: str) -> None:
        self.outbound.publication_refused(stream, code, text)
