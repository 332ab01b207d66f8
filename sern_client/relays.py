"""The relays of a client: the keys for each, at which one it is, and how it goes from one to another.

When it goes, and to which, `sern_core/site/relay_choice.py` says. Here the one that it is at is watched, those that it
prefers are asked (`relay_probe.py`), and the connection is led elsewhere. To the core another relay is what a relay
that was restarted is: reliable streams go on, once and in order.
"""

import asyncio
import logging
import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from random import Random
from typing import Final

import zmq

from sern_client.connection import Connection
from sern_client.keyring import ClientKeyring, KeyFiles
from sern_client.link_news import LinkNews
from sern_client.relay_probe import RelayProbe
from sern_core.site.client import ClientCore
from sern_core.site.relay_choice import Move, MoveReason, RelayChoice
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.key_news import ClientKeys, RelayKeys
from sern_runtime import clock
from sern_runtime.config.client import ClientFile, RelayConnection
from sern_runtime.config.load import Loaded
from sern_runtime.events import EventLog
from sern_runtime.metrics import Metrics
from sern_runtime.transport_watch import NOT_YET
from sern_runtime.zmq_setup import CurvePair

LOOK_S: Final = 0.25
WHY: Final = {
    MoveReason.RETURN: "that one answers again, and is preferred",
    MoveReason.FOLLOW: "that one is preferred, and a peer has gone back",
}

_log = logging.getLogger(__name__)


class RelayEntry:
    """One relay of the list, and what is known of it."""

    def __init__(self, place: int, section: RelayConnection, keyring: ClientKeyring | None) -> None:
        self.place = place
        self.section = section
        self.keyring = keyring
        self.name = ""
        """What it calls itself; empty: there was no session with it yet."""
        self.why = NOT_YET
        """Why it did not answer when it was tried last; empty: it did."""
        self.probe: RelayProbe | None = None

    @property
    def address(self) -> str:
        """Its address as the file has it."""
        return self.section.endpoint

    @property
    def words(self) -> str:
        """Its address, and its name where that is known."""
        return f"{self.address} ({self.name})" if self.name else self.address

    @property
    def keys(self) -> tuple[CurvePair | None, Sequence[str]]:
        """Our pair, and those of the relay that are accepted."""
        return (None, ()) if self.keyring is None else (self.keyring.keys, self.keyring.server_keys)


class Relays:
    """`read`, then `open`, then `run` in a task; `stay` before the client says goodbye for good, then `close`.

    `on_down` is told why there is no connection, `kick` that the core may have something to send."""

    def __init__(
        self,
        loaded: Loaded[ClientFile],
        core: ClientCore,
        events: EventLog,
        *,
        on_down: Callable[[str], None],
        kick: Callable[[], None],
    ) -> None:
        model = loaded.model
        self._loaded = loaded
        self._core = core
        self._events = events
        self._on_down = on_down
        self._kick = kick
        self._ctx: zmq.Context[zmq.Socket[bytes]] | None = None
        self._random = Random(secrets.randbits(64))
        self.entries = [RelayEntry(i, each, self._keyring(i, each)) for i, each in enumerate(model.all_relays)]
        """The relays in the order of preference."""
        self.choice = RelayChoice(
            [each.handshake_interval_s for each in model.all_relays],
            failover_s=model.failover.failover_s,
            return_s=model.failover.return_s,
            now=clock.now(),
        )
        first = self.entries[0]
        self.connection = Connection(
            core, first.section, model.link, on_down=self._down, on_refused=lambda: self._refused(self.current)
        )
        self.news = LinkNews(core.link, first.address, events)
        self.moves: Counter[tuple[str, str]] = Counter()
        """How often there was a session at another relay than before, by the address of that one and why."""
        self._was_at = first  # where the last session was
        self._reason = MoveReason.SILENT  # why it was left
        self._tried: list[RelayEntry] = []  # since then
        self._said_away = False
        self._looked_s = clock.now()
        self._staying = False

    def _keyring(self, place: int, relay: RelayConnection) -> ClientKeyring | None:
        if relay.secret_key_file is None or relay.server_key_file is None:
            return None

        def use(redial: bool) -> None:
            self._use_keys(self.entries[place], redial)

        def tell(keys: ClientKeys) -> None:
            self._tell_keys(self.entries[place], keys)

        files = KeyFiles(self._loaded.resolve(relay.secret_key_file), self._loaded.resolve(relay.server_key_file))
        return ClientKeyring(files, use=use, tell=tell, at_s=time.time)

    @property
    def current(self) -> RelayEntry:
        """The one that the client is at, or tries."""
        return self.entries[self.choice.at]

    @property
    def several(self) -> bool:
        """Whether there is another one."""
        return len(self.entries) > 1

    # --- from start to end ------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Read the keys for all of them. Raises ConfigError."""
        for entry in self.entries:
            if entry.keyring is not None:
                entry.keyring.read()

    def open(self, ctx: "zmq.Context[zmq.Socket[bytes]]") -> None:
        """Connect to the first. Raises ConfigError."""
        self._ctx = ctx
        self._tried = [self.current]
        self.connection.open(ctx, *self.current.keys)

    async def run(self) -> None:
        """Look after them for as long as the client runs."""
        while True:
            await asyncio.sleep(LOOK_S)
            if self.several:
                await self.look()

    async def look(self) -> None:
        """Ask those that are preferred, and go to another one if that is due."""
        now = clock.now()
        for entry in self.entries:
            if entry.place in self.choice.better:
                self._ask(entry)
            else:
                self._ask_no_more(entry)
        move = self.choice.look(
            now,
            answers=self._answers(),
            letting_in=self.connection.letting_in,
            left_behind=bool(self._core.peers.moved),
        )
        self._looked_s = now
        if move is not None and not self._staying:
            await self._go(move)

    def stay(self) -> None:
        """The client stops: it goes nowhere else."""
        self._staying = True

    async def close(self) -> None:
        """Let go of what asks, and wait for keys that are being written."""
        for entry in self.entries:
            self._ask_no_more(entry)
        for entry in self.entries:
            if entry.keyring is not None:
                await entry.keyring.close()

    # --- whether they answer ----------------------------------------------------------------------------------------

    def _answers(self) -> bool:
        """Whether the relay has answered since the last look, on whatever lane."""
        link, since_s = self._core.link, self._looked_s
        if link.handshake.displaced:
            return True  # it says that another process has our name: no other relay would know better
        if link.established:
            return not link.lane.stalled and link.heard_s is not None and link.heard_s >= since_s
        up_s = self.connection.up_s
        return up_s is not None and up_s >= since_s

    def _ask(self, entry: RelayEntry) -> None:
        if entry.probe is None and self._ctx is not None:
            entry.probe = RelayProbe(
                self._ctx,
                entry.section,
                self._loaded.model.link,
                *entry.keys,
                tag=lambda: max(1, self._core.link.end.tag),
                random=self._random,
                answered=lambda: self._answered(entry),
                refused=lambda: self._refused(entry),
            )
            try:
                entry.probe.open()
            except (zmq.ZMQError, ConfigError) as error:  # out of file descriptors, for example: that passes
                self._ask_no_more(entry)
                entry.why = str(error)
                return
        if entry.probe is not None:
            entry.probe.tick()

    def _answered(self, entry: RelayEntry) -> None:
        self.choice.answered(entry.place, clock.now())

    def _ask_no_more(self, entry: RelayEntry) -> None:
        if entry.probe is not None:
            entry.probe.close()
            entry.probe = None

    def _down(self, reason: str) -> None:
        if not self._core.link.established:
            self.current.why = reason
        self._on_down(reason)

    # --- going ------------------------------------------------------------------------------------------------------

    async def _go(self, move: Move) -> None:
        old, new = self.current, self.entries[move.to]
        if move.reason is not MoveReason.SILENT:
            why = f"it goes back to relay {new.words}"
            await self.connection.settle()
            if self._staying:
                return
            self.news.leaves(why)
            self.connection.goodbye(why, moved=True)
        else:
            why = f"it has not answered for {self.choice.silent_s:.0f} s; going on to relay {new.words}"
            self._silent(old, new)
        if old is self._was_at:
            self._reason = move.reason
        ready = None
        if new.probe is not None:
            ready, new.probe = new.probe.release(), None
        self.connection.leave_for(new.section, why)
        self.choice.moved(move.to, clock.now())
        self.news.relay = new.address
        try:
            if self._ctx is not None:
                self.connection.open(self._ctx, *new.keys, ready=ready)
        except (zmq.ZMQError, ConfigError) as error:  # then it does not answer, and the next one is tried
            self._down(f"no connection can be made: {error}")

    def _silent(self, old: RelayEntry, new: RelayEntry) -> None:
        """Note why a relay is left, and say once that all of them are away."""
        if self._core.link.established or not old.why:
            old.why = "it does not answer"
        if new not in self._tried:
            self._tried.append(new)
        elif not self._said_away:
            self._said_away = True
            words = "no relay answers; trying one after the other until one does: %s"
            self._events.say(_log, logging.WARNING, "relays_away", "", words, self.tried)

    def arrived(self) -> None:
        """There is a session with the current one."""
        entry, before = self.current, self._was_at
        entry.name, entry.why = self._core.link.peer, ""
        if entry is not before:
            self.moves[entry.address, str(self._reason)] += 1
            why = WHY.get(self._reason, before.why)
            between = [f"{each.words}: {each.why}" for each in self._tried if each not in (before, entry)]
            words = "moved from relay %s to %s: %s"
            self._events.say(
                _log, logging.WARNING, "moved", entry.name, words, before.words, entry.words,
                "; tried in between: ".join([why, *([", ".join(between)] if between else [])]),
                reason=str(self._reason),
            )  # fmt: skip
        self._was_at, self._tried, self._said_away = entry, [entry], False
        self._reason = MoveReason.SILENT

    @property
    def tried(self) -> str:
        """Those that were tried since the last session, and why there is none with them."""
        return ", ".join(f"{each.words}: {each.why}" for each in self._tried)

    # --- keys -------------------------------------------------------------------------------------------------------

    def _use_keys(self, entry: RelayEntry, redial: bool) -> None:
        if entry.keyring is None:
            return
        keys, server_keys = entry.keyring.keys, entry.keyring.server_keys
        if entry is self.current:
            self.connection.use(keys, server_keys, redial=redial)
        elif entry.probe is not None:
            entry.probe.use(keys, server_keys)

    def _tell_keys(self, entry: RelayEntry, keys: ClientKeys) -> None:
        if entry is self.current and self._core.link.established:
            self._core.tell_keys(keys, now=clock.now())
            self._kick()

    def _refused(self, entry: RelayEntry) -> None:
        if entry.keyring is not None:
            entry.keyring.refused()

    def reload_keys(self) -> None:
        """Read the keys for all of them anew."""
        for entry in self.entries:
            if entry.keyring is not None:
                entry.keyring.reload()

    def keys_told(self, keys: RelayKeys) -> None:
        """The current one tells of its keys."""
        if self.current.keyring is not None:
            self.current.keyring.told(keys)

    def session_ended(self) -> None:
        """There is no session with the current one any more."""
        if self.current.keyring is not None:
            self.current.keyring.session_ended()

    def look_at_keys(self) -> None:
        """Offer again what was not taken. Call about twice a second."""
        if self.current.keyring is not None:
            self.current.keyring.look()

    # --- what is told -----------------------------------------------------------------------------------------------

    def keys_json(self) -> dict[str, object]:
        """What `sern keys` asks: of the current one."""
        keyring = self.current.keyring
        return {} if keyring is None else keyring.to_json()

    def to_json(self) -> dict[str, object]:
        """The relay at which the client is, and how it is with the others."""
        now, at = clock.now(), self.current
        return {
            "address": at.address,
            "name": at.name or None,
            "preferred": at.place == 0,
            "moves": sum(self.moves.values()),
            "relays": [
                {
                    "address": each.address,
                    "name": each.name or None,
                    "at": each is at,
                    "answering_s": self.choice.answering_s(each.place, now),
                    "why": each.why if each.probe is None else each.probe.why,
                }
                for each in self.entries
            ],
        }

    def register(self, metrics: Metrics) -> None:
        def up(entry: RelayEntry) -> bool:
            return entry is self.current and self._core.link.established

        metrics.gauge(
            "sern_client_at_relay",
            "1 for the relay of its list with which the client has a session.",
            ("relay",),
            lambda: [((each.address,), float(up(each))) for each in self.entries],
        )
        metrics.counter(
            "sern_client_failovers_total",
            "Times the client had a session at another relay than before, by that one and why: silent, return, follow.",
            ("relay", "reason"),
            lambda: [
                ((each.address, str(reason)), float(self.moves[each.address, str(reason)]))
                for each in (self.entries if self.several else ())  # from 0 on: else the first would be no increase
                for reason in MoveReason
            ],
        )
