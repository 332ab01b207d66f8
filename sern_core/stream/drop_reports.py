"""Drops of reliable messages that the peer is still to hear of, for one incoming stream; they survive the session.

Those that are not on their way yet lie in the order of their messages, and no two of them name the same one: the origin
counts the first report of a message and no other. Neighbours are one run. So a stream has no more reports than its
origin has messages that are not confirmed, whoever drops them and in whatever order.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from itertools import pairwise
from operator import attrgetter
from typing import Final

from sern_core.vocabulary.errors import WireError
from sern_core.vocabulary.limits import LIMITS, PeerLimits
from sern_core.vocabulary.types import DropReason

UNREAD_S: Final = 10.0
"""How long a peer may go on sending while it reads none of the reports that were said in the session."""
STEP_S: Final = 1.0
"""What the pause between two of its messages counts for that at most: if we were held up, its words wait as well."""


class UnackedReports:
    """How much is to be reported to one peer, of all its streams, and whether it reads."""

    __slots__ = ("_last_s", "_unread_s", "limits", "reports", "said")

    def __init__(self, limits: PeerLimits = LIMITS) -> None:
        self.limits = limits
        self.reports = 0
        self.said = 0  # of these, in the session
        self._unread_s = 0.0
        self._last_s = -float("inf")

    @property
    def crowded(self) -> bool:
        return self.reports > self.limits.reports

    def begin(self) -> None:
        """A session has begun: nothing was said in it."""
        self._unread_s = 0.0

    def acknowledged(self, count: int) -> None:
        self.reports -= count
        self.said -= count
        self._unread_s = 0.0

    def check(self, now: float) -> None:
        """The peer has sent a reliable message although the table is crowded. What it was not told yet is not its
        fault: others make the reports. Raises WireError if it reads none of those that it was told."""
        if not self.said:
            return
        self._unread_s += min(now - self._last_s, STEP_S)
        self._last_s = now
        if self._unread_s > UNREAD_S:
            raise WireError(
                f"the peer went on sending for {UNREAD_S:g} s and read none of the {self.said} reports of drops that "
                f"it was told, of {self.reports} in all"
            )


class DropReport:
    """Reliable messages, `count` from `seq` on, dropped here or further on, of which the peer must know before its
    watermark passes them. `where` names who will not get them; empty: several."""

    __slots__ = ("control_seq", "count", "reason", "seq", "where")

    def __init__(self, seq: int, reason: DropReason, where: str, count: int = 1) -> None:
        self.seq = seq
        self.count = count
        self.reason = reason
        self.where = where
        self.control_seq = 0  # the control message of the session that carries it; 0: none yet

    @property
    def end(self) -> int:
        """The seq behind the last of them."""
        return self.seq + self.count


_SEQ: Final = attrgetter("seq")
_END: Final = attrgetter("end")


class DropReports:
    """The reports of one stream."""

    __slots__ = ("_said", "_unacked", "_unsaid")

    def __init__(self, unacked: UnackedReports) -> None:
        self._unacked = unacked
        self._said: list[DropReport] = []  # as they were said
        self._unsaid: list[DropReport] = []  # by seq; none overlaps another

    def __len__(self) -> int:
        return len(self._said) + len(self._unsaid)

    @property
    def said(self) -> int:
        """How many are on their way."""
        return len(self._said)

    def add(self, seq: int, reason: DropReason, where: str, count: int = 1) -> None:
        """The peer is to hear that `count` messages from `seq` on were dropped. What is to be told of them already
        stays as it is; if the table is crowded, a run that holds others takes their place."""
        unsaid, end = self._unsaid, seq + count
        low = bisect_right(unsaid, seq, key=_END)
        high = bisect_left(unsaid, end, lo=low, key=_SEQ)
        if low < high and unsaid[low].seq <= seq and end <= unsaid[low].end:
            return
        if low < high and self._unacked.crowded:
            first, last = unsaid[low], unsaid[high - 1]
            start, end = min(first.seq, seq), max(last.end, end)
            reason = first.reason if reason is DropReason.UNWANTED else reason  # the worse news of the two
            parts = [DropReport(start, reason, "", end - start)]
        else:
            parts = _between(unsaid[low:high], seq, end, reason, where)
        if low > 0:
            low -= 1
            parts.insert(0, unsaid[low])
        if high < len(unsaid):
            parts.append(unsaid[high])
            high += 1
        parts = self._joined(parts)
        more = len(parts) - (high - low)
        if more > 0 and self._unacked.reports + more > self._unacked.limits.kept_reports:
            return
        unsaid[low:high] = parts
        self._unacked.reports += more

    def _joined(self, parts: list[DropReport]) -> list[DropReport]:
        """The same with neighbours that say the same as one."""
        joined = [parts[0]]
        for report in parts[1:]:
            last = joined[-1]
            alike = last.where == report.where
            if last.end == report.seq and last.reason is report.reason and (alike or self._unacked.crowded):
                last.count += report.count
                last.where = last.where if alike else ""
            else:
                joined.append(report)
        return joined

    def first(self, *, runs: bool) -> DropReport | None:
        """What is to be said next; without `runs`, of one message."""
        if not self._unsaid:
            return None
        report = self._unsaid[0]
        return report if runs or report.count == 1 else DropReport(report.seq, report.reason, report.where)

    def say(self, report: DropReport, control_seq: int) -> None:
        """`first` is on its way, in a control message of this number."""
        whole = self._unsaid[0]
        if whole is report:
            del self._unsaid[0]
        else:
            whole.seq += report.count
            whole.count -= report.count
            self._unacked.reports += 1
        report.control_seq = control_seq
        self._said.append(report)
        self._unacked.said += 1

    def acknowledged(self, control_seq: int) -> bool:
        """The peer has the control messages up to this one. Returns whether it knows of all drops."""
        said = self._said
        if said and said[0].control_seq <= control_seq:
            count = next((index for index, each in enumerate(said) if each.control_seq > control_seq), len(said))
            del said[:count]
            self._unacked.acknowledged(count)
        return not said and not self._unsaid

    def unsay(self) -> None:
        """The session is over: what the peer has not acknowledged is to be said again."""
        said, self._said = self._said, []
        self._unacked.reports -= len(said)
        self._unacked.said -= len(said)
        for report in said:
            self.add(report.seq, report.reason, report.where, report.count)

    def clear(self) -> None:
        """The stream is gone, or what it was has been replaced."""
        self._unacked.reports -= len(self)
        self._unacked.said -= len(self._said)
        self._said.clear()
        self._unsaid.clear()

    def validate(self, check: Callable[[bool, str], None], name: str) -> None:
        unsaid = self._unsaid
        check(all(report.count > 0 for report in unsaid), f"{name}: a report of nothing")
        check(
            all(one.end <= other.seq for one, other in pairwise(unsaid)),
            f"{name}: reports out of order, or two of a message",
        )
        numbers = [report.control_seq for report in self._said]
        check(all(numbers) and numbers == sorted(numbers), f"{name}: said reports are out of order")


def _between(known: list[DropReport], seq: int, end: int, reason: DropReason, where: str) -> list[DropReport]:
    """`known`, and reports of what they leave out from `seq` up to `end`, by seq."""
    parts: list[DropReport] = []
    for report in known:
        if seq < report.seq:
            parts.append(DropReport(seq, reason, where, report.seq - seq))
        parts.append(report)
        seq = report.end
    if seq < end:
        parts.append(DropReport(seq, reason, where, end - seq))
    return parts
