"""What one end of a hop tells the other about its streams: whether they are wanted, and what was dropped of them. Pure.

Answers say nothing that the peer knows (`Interest`). Reports of drops wait until the peer has acknowledged the latest,
and become runs of messages meanwhile; they survive the session.
"""

from typing import Final

from sern_core.link.control_stream import ControlStream
from sern_core.link.end import End
from sern_core.link.interest import Interest
from sern_core.stream.in_stream import InStream, Reassembly
from sern_core.vocabulary.types import DROP_CODES, DropReason
from sern_core.wire.announce import encode_dropped

MAX_REPORTS_UNACKED: Final = 64
"""Control messages that may wait for the peer's acknowledgement before reports of drops wait as well."""


class Answers:
    """Answers to the streams that the peer has announced."""

    def __init__(self, end: End, control: ControlStream, reassembly: Reassembly) -> None:
        self._end = end
        self._control = control
        self._reassembly = reassembly
        self._interest = Interest()
        self._reporting: dict[InStream, None] = {}  # streams with drops that the peer is still to be told of
        self.unsaid = False
        """Answers or reports wait to be told: `say` is to be called."""

    def begin(self) -> None:
        """A session has begun: nothing was said in it."""
        self._interest.begin()
        self._reassembly.unacked_reports.begin()
        self._reporting.clear()
        self.unsaid = False

    def batches(self, understood: bool) -> None:
        """Whether the peer understands several channels in one message, and differences."""
        self._interest.batches = understood

    def expect(self, stream: InStream, channel_id: int) -> None:
        """The peer has announced a stream: it waits for an answer, whatever it was told before, and for reports."""
        self._interest.forget(channel_id)
        stream.reports.unsay()
        if stream.reports:
            self._reporting[stream] = None
            self.unsaid = True

    def forget(self, stream: InStream) -> None:
        """The stream is gone, or refused."""
        self._reporting.pop(stream, None)
        if stream.channel_id is not None:
            self._interest.forget(stream.channel_id)

    def answer(self, stream: InStream, wanted: bool, *, now: float, required: tuple[str, ...] = ()) -> None:
        """Tell the peer, if it does not know, whether its stream is wanted; `required` names the clients that must get
        a reliable one."""
        if not stream.reliable:
            required = ()
        if not self._end.established or stream.channel_id is None:
            stream.wanted = wanted
            stream.paused = stream.paused or not wanted
            stream.pause_seq = 0
        elif self._interest.answer(stream.channel_id, stream, wanted, required, now=now):
            self.unsaid = self._end.dirty = True

    def report(self, stream: InStream, seq: int, reason: DropReason, where: str, count: int = 1) -> None:
        """Tell the origin's side that reliable messages, `count` from `seq` on, were dropped here or further on: before
        the watermark passes them, and again in the next session until it is known there."""
        stream.reports.add(seq, reason, where, count)
        if stream.channel_id is not None:
            self._reporting[stream] = None
            self.unsaid = self._end.dirty = True

    def say(self, now: float) -> None:
        """Queue control messages with answers and reports that are due."""
        self._say_reports(now)
        control = self._control
        self._interest.tell(
            lambda envelope: control.send(envelope, now=now),
            acked_seq=control.acked_seq,
            unacked=len(control.out.retained),
            now=now,
        )
        self.unsaid = bool(self._interest or self._reporting)

    @property
    def deadline_s(self) -> float:
        """When `say` has something to say by time alone."""
        return self._interest.deadline_s

    def _say_reports(self, now: float) -> None:
        """Say so many reports as the peer can be expected to hear of soon; those that wait grow into runs meanwhile."""
        retained = self._control.out.retained
        for stream in list(self._reporting):
            channel_id = stream.channel_id
            reports, runs = stream.reports, self._interest.batches
            while channel_id is not None and (report := reports.first(runs=runs)) is not None:
                if len(retained) >= MAX_REPORTS_UNACKED:
                    return
                code = DROP_CODES[report.reason]
                envelope = encode_dropped(channel_id, report.seq, code, report.where, report.count)
                reports.say(report, self._control.send(envelope, now=now))
            del self._reporting[stream]
