"""Command topics that are published here: their leases, what is said when commands stay away, and what the guard knows.

A lease is of one stream. A stream that ends while its robot is being slowed down leaves its lease and publisher until
that is over: the operator who left and the one who lost the link are the same to a robot that drives.
"""

import logging
import time
from collections.abc import Callable, KeysView
from dataclasses import dataclass, field
from typing import Final

from sern_client.e_stop import EStops
from sern_client.guard import Guard
from sern_client.holding import Holding
from sern_client.site import Site
from sern_core.bodies.twist import TwistBody
from sern_core.site.client import ClientCore
from sern_core.site.lease import CommandLease
from sern_core.topics.patterns import PatternSet
from sern_core.topics.rules import Lease
from sern_core.vocabulary.message import StreamId, TopicInfo
from sern_core.vocabulary.types import DropReason, TopicName
from sern_runtime import clock
from sern_runtime.fine_timer import fine_timer

MAX_ENDING: Final = 64
"""Streams that have ended and whose robot is still being slowed down; of more the robot is told to stand at once."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Command:
    """A command topic from elsewhere. `stop` is the body of its stop command; `publish` says something at the endpoint,
    `close` ends that. `guarded`: what the guard calls it; None: there is none."""

    stream: StreamId
    info: TopicInfo
    lease: CommandLease
    ramped: bool
    stop: bytes
    publish: Callable[[bytes, int], None]
    close: Callable[[], None]
    guarded: int | None = field(default=None)


class Commands:
    """Keeps the leases of all command topics of a site. `guard` speaks while this process cannot."""

    def __init__(self, site: Site, core: ClientCore, guard: Guard | None) -> None:
        self.leases_fired = 0
        self.holding: Holding | None = None
        """Who of several operators is obeyed; None: all are."""
        self.e_stops: EStops | None = None
        """The e-stops of this site: while one is latched no command is obeyed. None: there are none."""
        self._site = site
        self._core = core
        self._guard = guard
        self._open: dict[StreamId, Command] = {}
        self._ending: dict[TopicName, Command] = {}
        self._timer = fine_timer(self._due)  # one that is due while the machine sleeps is due when it wakes

    @property
    def due_s(self) -> float | None:
        """When something is published next unless a command comes; None: no lease runs."""
        return self._timer.deadline_s

    @property
    def ending(self) -> KeysView[TopicName]:
        """Local names under which something is published still although their stream has ended."""
        return self._ending.keys()

    def opened(
        self,
        stream: StreamId,
        info: TopicInfo,
        rule: Lease,
        stop: bytes,
        *,
        publish: Callable[[bytes, int], None],
        close: Callable[[], None],
    ) -> None:
        """A stream of commands that is published here, as `info`, from now on."""
        lease = CommandLease(rule.after_s, rule.ramp)
        command = Command(stream, info, lease, rule.ramp is not None, stop, publish, close)
        if self._guard is not None:
            command.guarded = self._guard.opened(info, stop, rule.ramp)
        self._open[stream] = command

    def refuses(self, stream: StreamId, local: TopicName, *, born_s: float, now: float) -> DropReason | None:
        """Why a message that comes now, of a topic called `local` here, is not to be obeyed; None: it is. Ask it of
        every message, also of topics without a lease, before `renew`."""
        if self.e_stops is not None and self.e_stops.stopped(local) is not None:
            return DropReason.E_STOP
        if self.holding is not None and not self.holding.obeys(local, stream.origin, now=now):
            return DropReason.NOT_HOLDER
        command = self._open.get(stream)
        if command is None:
            return None
        if command.lease.overtaken(born_s=born_s, now=now):
            return DropReason.SUPERSEDED
        return None

    def halt(self, names: PatternSet) -> None:
        """Tell the robots of these command topics (local names) to stand, at once and without a ramp."""
        for command in (*self._open.values(), *self._ending.values()):
            if names.fullmatch(command.info.name):
                command.lease.halt(now=clock.now())
                command.publish(command.stop, time.time_ns())
                if self._guard is not None and command.guarded is not None:
                    self._guard.commanded(command.guarded, command.lease.deadline(), None)
        self._arm()

    def renew(self, stream: StreamId, body: bytes, *, born_s: float, now: float) -> None:
        """A command is about to be published as `body`: no stop command of before may come after it."""
        command = self._open.get(stream)
        if command is None:
            return
        ending = self._ending.pop(command.info.name, None)
        if ending is not None:
            self._over(ending)  # the robot has a new operator
        lease = command.lease
        read = TwistBody.read(command.info.type_name, command.info.encoding, body) if command.ramped else None
        lease.renew(born_s=born_s, now=now, command=read)
        self._arm()
        if self._guard is not None and command.guarded is not None:
            said = body if read is not None else None
            self._guard.commanded(command.guarded, lease.deadline(), said)

    def ended(self, stream: StreamId, local: TopicName) -> bool:
        """No more commands will come from there: the last one must not stand. True: what it is published with is closed
        here, once the robot stands."""
        if self.holding is not None:
            self.holding.ended(local, stream.origin)
        command = self._open.pop(stream, None)
        if command is None:
            return False
        armed = command.lease.deadline() is not None
        if armed and command.ramped and len(self._ending) < MAX_ENDING:
            before = self._ending.pop(command.info.name, None)
            if before is not None:
                self._over(before)
            self._ending[command.info.name] = command
            return True
        self._stop(command)
        return False

    def close(self) -> None:
        """Tell every robot that is being commanded to stand still, at once. Call it before the endpoint is stopped."""
        self._timer.close()
        for command in self._open.values():
            self._stop(command)
        for command in self._ending.values():
            self._stop(command)
            command.close()
        self._open.clear()
        self._ending.clear()

    def _stop(self, command: Command) -> None:
        if command.lease.deadline() is not None:
            command.publish(command.stop, time.time_ns())
        self._unguard(command)

    def _over(self, command: Command) -> None:
        self._unguard(command)
        command.close()

    def _unguard(self, command: Command) -> None:
        if self._guard is not None and command.guarded is not None:
            self._guard.closed(command.guarded)

    def _arm(self) -> None:
        commands = (*self._open.values(), *self._ending.values())
        deadlines_s = [due_s for command in commands if (due_s := command.lease.deadline()) is not None]
        self._timer.arm(min(deadlines_s) if deadlines_s else None)

    def _due(self) -> None:
        now = clock.now()
        for command in (*self._open.values(), *self._ending.values()):
            self._speak(command, now)
        for name, command in list(self._ending.items()):
            if command.lease.deadline() is None:
                del self._ending[name]
                self._over(command)
        self._arm()

    def _speak(self, command: Command, now: float) -> None:
        """Say what is due, if anything is."""
        lease = command.lease
        first = not lease.expired
        if not lease.due(now=now):
            return
        slowed = lease.slowed(now=now)
        command.publish(command.stop if slowed is None else slowed, time.time_ns())
        if self._guard is not None and command.guarded is not None:
            self._guard.lease(command.guarded, lease.deadline(), since_s=lease.slowing_since_s)
        if first:
            self.leases_fired += 1
            self._core.lease_expired(command.stream, lease.after_s, now=now)
            words = (
                "%s: no fresh command; publishing the stop command"
                if slowed is None
                else "%s: no fresh command; slowing the robot down"
            )
            self._site.events.say(
                _log, logging.WARNING, "command_stopped", command.info.name, words, command.info.name,
                after_s=lease.after_s,
            )  # fmt: skip
