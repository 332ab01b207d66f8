"""The connections under one priority lane: class control over TCP, apart from everything else, twice where TCP loses.

TCP delivers what was lost one round trip late or more, and whatever follows waits for it. Two connections seldom wait
at the same time: so while segments are lost, each datagram goes over both, and the one that arrives first counts. Both
carry the same packet number, by which the core knows a copy.
"""

from collections.abc import Callable
from typing import Final, Generic, TypeVar

from sern_core.path.lanes import COPY_LOSS
from sern_core.vocabulary.params import Redundancy
from sern_runtime.monitor import TcpHandle
from sern_runtime.zmq_socket import SendResult

Key = TypeVar("Key")

CONNECTIONS: Final = 2
MEMORY: Final = 0.9
"""What the loss seen before counts for at the next look; looks are half a second or a second apart."""
MIN_SEGMENTS: Final = 40.0
"""Fewer do not tell 0.5 %: one lost segment in the first ten is no reason to send everything twice."""


class SegmentLoss:
    """Share of the recent segments of a TCP connection that were sent again, by the kernel's own counters."""

    def __init__(self, handle: TcpHandle | None) -> None:
        self._handle = handle
        self._before = (0, 0)
        self._sent = 0.0
        self._again = 0.0

    def look(self) -> None:
        info = self._handle.info() if self._handle is not None else None
        if info is None:
            return
        sent, again = info.sent_segments, info.retransmitted_segments
        self._sent = MEMORY * self._sent + sent - self._before[0]
        self._again = MEMORY * self._again + again - self._before[1]
        self._before = (sent, again)

    @property
    def share(self) -> float:
        return self._again / self._sent if self._sent >= MIN_SEGMENTS else 0.0


class PriorityPaths(Generic[Key]):
    """Sends each datagram over the first connection that takes it, or over all of them. Call `look` now and then.

    `may_copy(nbytes)` is asked before each copy: on a full link copies would make the losses that they are sent for.
    """

    def __init__(self, redundancy: Redundancy, may_copy: Callable[[int], bool]) -> None:
        self._may_copy = may_copy
        self.copying = redundancy is Redundancy.ALWAYS
        self._redundancy = redundancy
        self._paths: dict[Key, tuple[Callable[[bytes], SendResult], SegmentLoss]] = {}

    def __len__(self) -> int:
        return len(self._paths)

    def __contains__(self, key: object) -> bool:
        return key in self._paths

    def add(self, key: Key, send: Callable[[bytes], SendResult], handle: TcpHandle | None) -> None:
        self._paths[key] = (send, SegmentLoss(handle))

    def discard(self, key: Key) -> None:
        self._paths.pop(key, None)

    def oldest(self) -> Key:
        return next(iter(self._paths))

    def clear(self) -> None:
        self._paths.clear()

    def look(self) -> None:
        """See what TCP loses."""
        for _send, loss in self._paths.values():
            loss.look()
        if self._redundancy is Redundancy.AUTO:
            self.copying = any(loss.share > COPY_LOSS for _send, loss in self._paths.values())

    def send(self, datagram: bytes) -> SendResult:
        """OK when one connection took it; a connection that is gone is its owner's to discard."""
        taken = SendResult.FULL
        for send, _loss in self._paths.values():
            if taken is SendResult.OK and not self._may_copy(len(datagram)):
                break
            if send(datagram):
                taken = SendResult.OK
                if not self.copying:
                    break
        return taken
