"""What a peer may cost, in one frozen object: the promises are its defaults, and tests see the same code under less."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class PeerLimits:
    """Bounds of one link, and of what a relay does for one peer. Beyond them it is cut or waits, as each says."""

    slice_us: int = 6000
    """What reading may cost at one go, in microseconds as they are charged for each frame. Then it rests as long, and
    whoever else is there has its turn."""
    channel_us: int = 80
    close_us: int = 30
    """What a peer is charged with for each channel that a relay opens or closes for it."""
    lapsed_a_sweep: int = 1_000
    """Messages of a link that are given up in one sweep: some milliseconds."""
    runs_told: int = 1_000
    """Runs of messages that were dropped together, and are told one by one: each is a line in a log."""
    draining: int = 256
    """Channels of one client that have ended and still deliver; beyond that the longest ended are given up."""
    required: int = 8192
    """Names in lists that have begun and not ended, and of one stream."""
    unread_bytes: int = 32 * 2**20
    """Datagrams of one peer that wait to be read: far more than any window lets a peer send that hears of none. Who
    sends more is cut."""
    peer_definition_bytes: int = 16 * 2**20
    """Texts that the streams of one peer may use; all types of a ROS distribution together have less than 2 MB."""
    reports: int = 16_384
    """Reports of drops that one peer has not acknowledged. Above it, neighbours are one run whichever clients they
    name, and a peer that goes on sending without reading any is cut."""
    kept_reports: int = 8 * 16_384
    """The most reports that are kept for one peer. What would be one more is counted like any drop, and not told."""
    told_at_once: int = 500
    """Messages about who is there, in one turn of the loop: some milliseconds."""
    unacked: int = 20_000
    """Control messages that a peer may have answered, beside four for each channel, before it reads an answer."""
    absent_topics: int = 2048
    """Streams held for one client that has not come back yet; origins name them, so there must be an end to it."""


LIMITS: Final = PeerLimits()
"""What holds where nobody says otherwise."""
