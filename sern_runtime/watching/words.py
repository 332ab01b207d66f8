"""Why messages were dropped, in words."""

from collections.abc import Mapping
from typing import Final

from sern_core.vocabulary.types import DropReason

DROPS: Final[Mapping[DropReason, str]] = {
    DropReason.LIFESPAN: "it was older than the topic's lifespan",
    DropReason.SUPERSEDED: "a newer message took its place",
    DropReason.RATE_CAP: "the topic's max_rate_hz, or the adaptation, left it out for a newer one",
    DropReason.UNWANTED: "nobody subscribes to it",
    DropReason.REFUSED: "the topic's queue is full, and the publisher was told no",
    DropReason.FORBIDDEN: "the relay's access rules forbid it",
    DropReason.RETENTION: "it waited longer than the topic's retention",
    DropReason.STALE: "it was stale and of the lowest class (ordering: paper)",
    DropReason.LOST: "parts of it were lost on the way",
    DropReason.DUPLICATE: "it had arrived already",
    DropReason.TOO_LARGE: "it is larger than link.max_message_bytes",
    DropReason.UNKNOWN_CHANNEL: "it came for a stream that had ended",
    DropReason.REASSEMBLY: "too many half-received messages at once",
    DropReason.DISCONNECTED: "whom it was for has gone for good",
    DropReason.SHUTDOWN: "the daemon was stopped, or the publisher ended, before it could go",
    DropReason.QUEUE_FULL: "more waits for this client than access.max_queue_bytes lets",
    DropReason.UNDECODABLE: "its body cannot be decoded",
    DropReason.UNCONFIRMED: "it was sent whole and never acknowledged: it may have arrived",
    DropReason.FAULT: "an error in the program; the daemon's log has it",
    DropReason.STORAGE: "the recording could not take it: disk full or gone",
    DropReason.E_STOP: "an e-stop was latched at the robot",
    DropReason.NOT_HOLDER: "another operator holds the topic",
    DropReason.TOO_SLOW: "the link is too slow for it to arrive within the topic's lifespan",
}


def dropped_because(reason: str) -> str:
    """Why a message was dropped."""
    return DROPS[DropReason(reason)] if reason in set(DropReason) else reason
