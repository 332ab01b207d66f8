"""What one end of a hop tells the other about its streams, and hears of its own: who wants them, and what was dropped.

Answers say nothing that the peer knows (`Interest`). Reports of drops wait while the peer has not heard the latest,
and become runs of messages meanwhile; they survive the session.
"""

from abc import abstractmethod
from dataclasses import replace
from typing import Final, Unpack

from sern_core.link.interest import Interest
from sern_core.link.session import Session, SessionArguments
from sern_core.stream.in_stream import InStream
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.types import DROP_CODES, DropReason
from sern_core.wire import framing
from sern_core.wire.announce import Want, encode_dropped

MAX_OWED: Final = 8192
"""Names in lists that have begun and not ended, and of one stream."""
MAX_NAMED: Final = 0x10000
"""Price of the answers of one datagram, beside that of one for each open channel: a few bytes name many channels."""
ANSWER_PRICE: Final = 16
"""What an answer about an open channel costs, next to one about a channel that is closed."""
NAMED_PER_US: Final = 16
ANSWER_US: Final = 6
OWED_PER_US: Final = 16
"""What naming channels, answers about open ones, and lists of names are charged with (`Reassembly.work_us`)."""
MAX_REPORTS_UNHEARD: Final = 64
"""Control messages that may wait for the peer's acknowledgement before reports of drops wait as well."""


class Answering(Session):
    """`Session` with answers and reports. `Link` adds what they are about."""

    def __init__(self, **session: Unpack[SessionArguments]) -> None:
        self._interest = Interest()
        self._reporting: dict[InStream, None] = {}  # streams with drops that the peer is still to be told of
        self._owed_parts: dict[tuple[str, int], list[str]] = {}  # by message and channel: more will come
        self._owed_unfinished = 0  # names in them
        self._price = self._priced_us = 0  # of the answers that came at this time
        super().__init__(**session)

    @abstractmethod
    def send_control(self, envelope: framing.Envelope, attachment: bytes = b"", *, now: float) -> int: ...

    @abstractmethod
    def _heard_of(self, channel: OutChannel, now: float) -> None:
        """The peer has said whether it wants this stream."""

    def _begin_answers(self) -> None:
        """A session has begun: nothing was said in it."""
        self._interest.begin()
        self.reassembly.unheard.begin()
        self._reporting.clear()
        self._owed_parts.clear()
        self._owed_unfinished = 0
        self._unsaid = False

    def _forget_answers(self, stream: InStream) -> None:
        """The stream is gone, or refused."""
        self._reporting.pop(stream, None)
        if stream.channel_id is not None:
            self._interest.forget(stream.channel_id)

    def _expect_answer(self, stream: InStream, slot: int) -> None:
        """The peer has announced a stream: it waits for an answer, whatever it was told before, and for reports."""
        self._interest.forget(slot)
        stream.reports.unsay()
        if stream.reports:
            self._reporting[stream] = None
            self._unsaid = True

    # --- to the peer --------------------------------------------------------------------------------------------------

    def answer(self, stream: InStream, wanted: bool, *, now: float, owed: tuple[str, ...] = ()) -> None:
        """Tell the peer, if it does not know, whether its stream is wanted; `owed` names the clients that must get a
        reliable one."""
        if not stream.reliable:
            owed = ()
        if not self.established or stream.channel_id is None:
            stream.wanted = wanted
            stream.paused = stream.paused or not wanted
            stream.pause_seq = 0
        elif self._interest.answer(stream.channel_id, stream, wanted, owed, now=now):
            self._unsaid = self.dirty = True

    def _say(self, now: float) -> None:
        self._say_reports(now)
        control = self._control
        self._interest.tell(
            lambda envelope: self.send_control(envelope, now=now),
            heard=control.watermark,
            unheard=len(control.retained),
            now=now,
        )
        self._unsaid = bool(self._interest or self._reporting)

    def _say_deadline(self) -> float:
        return self._interest.deadline_s

    def report_drop(
        self, stream: InStream, seq: int, reason: DropReason, where: str, *, now: float, count: int = 1
    ) -> None:
        """Tell the origin's side that reliable messages, `count` from `seq` on, were dropped here or further on: before
        the watermark passes them, and again in the next session until it is known there."""
        stream.reports.add(seq, reason, where, count)
        if stream.channel_id is not None:
            self._reporting[stream] = None
            self._unsaid = self.dirty = True

    def _say_reports(self, now: float) -> None:
        """Say so many reports as the peer can be expected to hear of soon; those that wait grow into runs meanwhile."""
        retained = self._control.retained
        for stream in list(self._reporting):
            slot = stream.channel_id
            reports, runs = stream.reports, self._interest.batches
            while slot is not None and (report := reports.first(runs=runs)) is not None:
                if len(retained) >= MAX_REPORTS_UNHEARD:
                    return
                code = DROP_CODES[report.reason]
                envelope = encode_dropped(slot, report.seq, code, report.where, report.count)
                reports.say(report, self.send_control(envelope, now=now))
            del self._reporting[stream]

    # --- from the peer ------------------------------------------------------------------------------------------------

    def _owed_so_far(self, key: tuple[str, int], names: tuple[str, ...], *, more: bool) -> tuple[str, ...] | None:
        """The names of a list that travels in parts, once it is complete."""
        if more:
            self._owed_unfinished += len(names)
            if self._owed_unfinished > MAX_OWED:
                raise WireError(f"{self.peer} leaves lists of more than {MAX_OWED} names unfinished")
            if names:
                self._owed_parts.setdefault(key, []).extend(names)
            return None
        if key not in self._owed_parts:
            return names
        parts = self._owed_parts.pop(key)
        self._owed_unfinished -= len(parts)
        return (*parts, *names)

    def _answers(self, want: Want, now: float) -> None:
        """The peer has said whether it wants streams of ours."""
        if not self.initiator:
            # Who is owed is for origins to remember: a client that takes a stream is owed it itself, and no more.
            want = replace(want, owed=(), add=(), drop=())
            if want.more:
                return
        first = want.runs[0][0]
        if want.more:
            self._owed_so_far(("want", first), want.owed or (), more=True)
            return
        owed = None if want.owed is None else self._owed_so_far(("want", first), want.owed, more=False)
        changed: dict[int, tuple[tuple[str, ...], tuple[str, ...]]] = {}  # by identity: what was owed, what is now
        for first, last in want.runs:
            self._charge(last - first + 1, now)
            self.reassembly.work_us += (last - first + 1) // NAMED_PER_US
            for slot in range(first, last + 1):
                channel = self.channels.get(slot)
                if channel is not None:  # else closed meanwhile
                    self._charge(ANSWER_PRICE, now)
                    self.reassembly.work_us += ANSWER_US
                    if owed is None:
                        before = channel.owed
                        if id(before) not in changed:  # channels that are owed alike share one list
                            changed[id(before)] = before, self._changed(before, want)
                        channel.owed = changed[id(before)][1]
                    else:
                        channel.owed = owed
                    self._answer_came(channel, want, now)

    def _changed(self, before: tuple[str, ...], want: Want) -> tuple[str, ...]:
        """What an answer by difference makes of a list of names."""
        self.reassembly.work_us += len(before) // OWED_PER_US
        names = dict.fromkeys(before) | dict.fromkeys(want.add)
        for name in want.drop:
            names.pop(name, None)
        if len(names) > MAX_OWED:
            raise WireError(f"{self.peer} owes a stream to more than {MAX_OWED} names")
        return tuple(names)

    def _charge(self, price: int, now: float) -> None:
        """Raises WireError if the peer answers more in one datagram than there is to be answered."""
        now_us = int(now * 1e6)
        if now_us != self._priced_us:
            self._price, self._priced_us = 0, now_us
        self._price += price
        if self._price > MAX_NAMED + 2 * ANSWER_PRICE * len(self.channels):
            raise WireError(f"{self.peer} answers the announcements of {len(self.channels)} channels again and again")

    def _answer_came(self, channel: OutChannel, want: Want, now: float) -> None:
        if want.on and channel.wanted is False and channel.reliable:
            self.send_control({"t": "first", "ch": channel.slot, "seq": channel.first_seq}, now=now)
        self._set_wanted(channel, want.on, now)
        channel.ready = True
        self._refresh(channel, now)
        self._heard_of(channel, now)

    def _set_wanted(
        self, channel: OutChannel, wanted: bool, now: float, *, reason: DropReason = DropReason.UNWANTED
    ) -> None:
        watermark = channel.watermark
        self.reassembly.work_us += channel.set_wanted(wanted, reason)
        if channel.watermark > watermark:
            self._watermark_moved(channel)
