"""Bytes beyond what the path holds that background traffic may have under way. Pure."""

from typing import Final

from sern_core.path.congestion.queue_view import QueueView

LESS_FRAGMENTS: Final = 0.25
FIRST_FRAGMENTS: Final = 0.05
PATIENT_EPOCHS: Final = 4
"""Epochs without a queue after which the known rate may be too low."""
MOST_DOUBLINGS: Final = 6


class Unqueued:
    """Fragments beyond the product of rate and round trip that find out whether the link carries more.

    The window does not do for what is in the background: it keeps a queue, a short one, so that the link never idles.
    In the background the link rather idles. So a little less than the product is under way while anything queues, and
    a little more while nothing does: with that in flight a greater rate shows, if there is one. Where the path stays
    empty it grows fast, as for a link of which too little was found out at the start."""

    __slots__ = ("_empty_epochs", "fragments")

    def __init__(self) -> None:
        self.fragments = -LESS_FRAGMENTS
        self._empty_epochs = 0

    def close_epoch(self, view: QueueView) -> None:
        if not view.empty:
            self.fragments, self._empty_epochs = -LESS_FRAGMENTS, 0
            return
        self._empty_epochs += 1
        doublings = min(max(0, self._empty_epochs - PATIENT_EPOCHS), MOST_DOUBLINGS)
        self.fragments = FIRST_FRAGMENTS * 2.0**doublings
