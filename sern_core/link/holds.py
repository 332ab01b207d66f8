"""Looks at what waits for the link, and says why each of it is not what is sent. Pure.

It is asked right after a datagram was filled, at most once in `LOOK_S`, and looks at a few streams each time: a link
over which much waits is looked at again soon, and what that costs does not grow with what waits.
"""

from math import inf
from typing import Any, Final

from sern_core.link.background import Background
from sern_core.link.control_stream import ControlStream
from sern_core.link.end import End
from sern_core.link.lane_set import LaneSet
from sern_core.link.send_trace import held_back
from sern_core.link.sender import Sender
from sern_core.path.lanes import LANE_PRIORITY, Lane
from sern_core.stream.coding import Coding
from sern_core.stream.out_channel import OutChannel
from sern_core.stream.scheduler import WaitReason
from sern_core.vocabulary.trace import Field, HoldReason
from sern_core.vocabulary.types import CLASS_LABELS, PriorityClass

LOOK_S: Final = 0.05
SPARSE_LOOK_S: Final = 0.2
"""The same where a trace has not every step."""
LOOKED_AT: Final = 8
"""Streams that are looked at each time, in turn."""

_REASONS: Final = {
    WaitReason.OUTRANKED: HoldReason.OUTRANKED,
    WaitReason.CLASS: HoldReason.CLASS,
    WaitReason.FLOOR: HoldReason.FLOOR,
    WaitReason.BUCKET: HoldReason.SHARE,
    WaitReason.INTERVAL: HoldReason.INTERVAL,
    WaitReason.ENCODING: HoldReason.ENCODER,
}


class Holds:
    """One link's. `due_s` is when it may be asked to `look` again."""

    def __init__(
        self, end: End, lanes: LaneSet, control: ControlStream, sender: Sender, background: Background
    ) -> None:
        self._end = end
        self._lanes = lanes
        self._control = control
        self._sender = sender
        self._background = background
        self._turn = 0
        self.due_s = -inf if end.trace.enabled else inf
        self.served: OutChannel | None = None
        """What was sent last: what is held now was passed over for it."""

    def look(self, now: float) -> None:
        """Tell the trace why what waits does."""
        trace = self._end.trace
        if not trace.enabled:
            self.due_s = inf
            return
        self.due_s = now + (LOOK_S if trace.steps else SPARSE_LOOK_S)
        sender = self._sender
        waiting = sender.scheduler.waiting()
        count = len(waiting)
        for at in range(min(count, LOOKED_AT)):
            channel = sender.channels[waiting[(self._turn + at) % count]]
            out = channel.active[0] if channel.active else channel.queue[0] if channel.queue else None
            if out is None:
                continue
            if out.coding is Coding.RUNNING:
                continue  # said when it began
            found = self._why(channel, now)
            if found is not None:
                reason, fields = found
                sender.told.held(channel, out, reason, now, **fields)
        self._turn = (self._turn + LOOKED_AT) % count if count else 0

    def _why(self, channel: OutChannel, now: float) -> tuple[HoldReason, dict[str, Field]] | None:
        """Why a channel that the scheduler knows of is not served; None: it is the next one, and may go."""
        lane = self._lane_of(channel)
        if lane.stalled:
            return HoldReason.SILENT, {}
        served, closed = self.served, not lane.open_at(now)
        if served is None or served is channel or self._sender.channels.get(served.channel_id) is not served:
            served = None
        if closed and served is not None and served.spec.priority < channel.spec.priority:
            return HoldReason.CLASS, self._before(served.channel_id)
        beside = self._lanes.priority_lane is not None
        # As if there were room, for that says who would take it; the room itself is what the first in line waits for.
        wait, chosen = self._sender.scheduler.waits_for(channel.channel_id, now, beside=beside)
        if wait is not None and wait is not WaitReason.WINDOW:
            return _REASONS[wait], self._before(chosen)
        if self._control.waits and channel.spec.priority is not PriorityClass.CONTROL:
            return HoldReason.CONTROL, {}
        if not closed and channel.spec.background and not self._background.room(lane, now):
            return HoldReason.WINDOW, {"inflight_bytes": lane.under_way_bytes}
        if not closed:
            return None
        if served is not None and served.spec.priority is channel.spec.priority:
            return HoldReason.OUTRANKED, self._before(served.channel_id)
        rate_bps = lane.estimator.rate_bps
        known: dict[str, Field] = {} if rate_bps is None else {"rate_bps": round(rate_bps)}
        if lane.window_open:
            return HoldReason.PACING, known
        return HoldReason.WINDOW, {"inflight_bytes": lane.flight.inflight_bytes, **known}

    def _lane_of(self, channel: OutChannel) -> Lane:
        own = self._lanes.priority_lane
        control = channel.spec.priority is PriorityClass.CONTROL
        return own if control and own is not None and own.id == LANE_PRIORITY else self._lanes.lane

    def _before(self, channel_id: int | None) -> dict[str, Field]:
        """Who goes first."""
        channel = None if channel_id is None else self._sender.channels.get(channel_id)
        if channel is None:
            return {}
        return {"after": channel.stream.id.topic, "after_class": CLASS_LABELS[channel.spec.priority]}

    def standing(self, channel: OutChannel, now: float) -> dict[str, Any]:
        """How a channel stands now: what waits, why, and how many go before it. Asking changes nothing."""
        sender = self._sender
        told: dict[str, Any] = {"waiting": channel.unbegun, "under_way": len(channel.flying)}
        out = channel.active[0] if channel.active else channel.queue[0] if channel.queue else channel.newest
        if out is None:
            return told
        told |= {
            "seq": out.seq,
            "begun": out.started,
            "age_s": now - out.message.born_s,
            "unsent_bytes": out.unsent_bytes,
        }
        standing = sender.scheduler.explain(channel.channel_id, now)
        gate = channel.gate
        if gate is not None and out is gate.newest:
            reason = HoldReason.ADAPTATION if gate.newest_thinned else HoldReason.RATE_CAP
            told |= {**held_back(channel, reason), "due_in_s": gate.newest_due_s - now}
        elif not channel.ready:
            told["reason"] = sender.told.unready_reason(channel)
        elif standing is not None:
            told |= {"rank": standing.rank, "score": standing.score}
            if out.coding is Coding.RUNNING:
                told["reason"] = "encoding"
            elif (found := self._why(channel, now)) is not None:
                told |= {"reason": found[0], **found[1]}
        return told
