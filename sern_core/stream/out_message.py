"""One message on its way over one hop: what of its body is still to be sent, and what became of the rest."""

from collections.abc import Iterator, Sequence
from operator import attrgetter
from typing import Final

from sern_core.stream.coding import Coding
from sern_core.vocabulary.message import Message
from sern_core.vocabulary.types import DROP_CODES, DropReason

BY_SEQ: Final = attrgetter("seq")


class OutMessage:
    """One message on its way over one hop. `ranges` are the parts of the body still to be sent, as [start, end).

    `size` is that of the body as it is now, `offered_bytes` as it was when it came: the counters count that one.
    """

    __slots__ = (
        "active",
        "coding",
        "counted",
        "exposed",
        "fragments_inflight",
        "generation",
        "lost_to",
        "message",
        "offered_bytes",
        "ranges",
        "retain_from_s",
        "seq",
        "size",
        "some_acked",
        "started",
    )

    def __init__(self, message: Message) -> None:
        self.message = message
        self.seq = message.seq
        self.size = self.offered_bytes = len(message.body)
        self.coding = Coding.RAW
        self.ranges: list[tuple[int, int]] | None = None  # None: untouched, send from 0
        self.generation = 0  # of the body: acknowledgements of an earlier one no longer count
        self.exposed = False  # all of it has left here: the peer, or an earlier process there, may have it
        self.some_acked = False
        self.fragments_inflight = 0
        self.started = False
        self.active = False  # in the list of those that were begun and have bytes still to send
        self.counted = False  # already accounted as dropped (a drop marker now)
        self.lost_to = ""  # the client further on that will not get it; empty: nobody did, or nobody was named
        self.retain_from_s = message.born_s  # retention counts from here

    @property
    def unsent_bytes(self) -> int:
        if self.ranges is None:
            return self.size
        return sum(end - start for start, end in self.ranges)

    @property
    def withheld(self) -> bool:
        """Whether it waits for its body to be encoded."""
        return self.coding is Coding.RUNNING or self.coding is Coding.HELD

    @property
    def has_unsent(self) -> bool:
        return self.ranges is None or bool(self.ranges)

    def expired(self, lifespan_s: float | None, now: float) -> bool:
        """Whether the lifespan of its topic is over. A drop marker has none."""
        message = self.message
        return (
            lifespan_s is not None and not message.drop_marker and now - message.born_s + message.error_s > lifespan_s
        )

    def restart(self) -> None:
        """Forget what was sent: the peer is a new process, or the body is another."""
        self.ranges = None
        self.generation += 1
        self.some_acked = False
        self.fragments_inflight = 0

    def mark_dropped(self, reason: DropReason) -> None:
        """Become a drop marker: one byte that says why."""
        old = self.message
        self.message = Message(
            old.stream, old.seq, bytes([DROP_CODES[reason]]), old.stamp_ns, old.born_s, drop_marker=DROP_CODES[reason]
        )
        self.size = 1
        self.coding = Coding.DONE
        self.restart()
        self.exposed = False
        self.counted = True


def in_sequence(outs: Sequence[OutMessage]) -> Iterator[Sequence[OutMessage]]:
    """Messages in runs of seqs that follow each other."""
    start = 0
    for index in range(1, len(outs) + 1):
        if index == len(outs) or outs[index].seq != outs[index - 1].seq + 1:
            yield outs[start:index]
            start = index
