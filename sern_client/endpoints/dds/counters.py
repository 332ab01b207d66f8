"""What became of the messages of a `dds` endpoint."""

from dataclasses import dataclass


@dataclass(slots=True)
class DdsCounters:
    """Messages by fate. Dropped: the event loop was too slow (`overrun`), slow reliable readers left a writer no room
    (`blocked`), too many calls of a service were under way (`calls`), or what came was no call, or too long to be about
    nodes (`unreadable`). What the link did not take (`refused`), the link counts. `closed`: given to a writer that is
    no more. `faults` of the thread that waits for DDS are of those that were; `DdsEndpoint.faults` has all."""

    received: int = 0
    overrun: int = 0
    refused: int = 0
    written: int = 0
    blocked: int = 0
    calls: int = 0
    unreadable: int = 0
    closed: int = 0
    faults: int = 0
