"""What the window from delay and rate is doing, and what makes it do something else.

        filled            stuck                      restart: from anywhere to start-up
STARTUP ------> STEADY <----------> COMPETE
   | rival       ^  |     gone       ^  |
   v             |  v make way       |  v make way
STARTUP_BESIDE   DRAIN               COMPETE_DRAIN
"""

from collections.abc import Mapping
from enum import Enum, auto
from types import MappingProxyType
from typing import Final


class Mode(Enum):
    """What the window is doing. While it competes a rival keeps the queue, and the window follows CUBIC."""

    STARTUP = (True, False, False)
    """It goes where the trains of packets point."""
    STEADY = (False, False, False)
    """It follows the queue."""
    DRAIN = (False, True, False)
    """It makes way for a round trip, to see the path empty."""
    COMPETE = (False, False, True)
    COMPETE_DRAIN = (False, True, True)
    """It makes way, to see whether the rival has gone."""
    STARTUP_BESIDE = (True, False, True)
    """It started again before a queue was judged that was found to be a rival's."""

    def __init__(self, starting: bool, draining: bool, competing: bool) -> None:
        self.starting = starting
        self.draining = draining
        self.competing = competing


class Event(Enum):
    """What changes the mode."""

    RESTART = auto()
    """The link may be another."""
    FILLED = auto()
    """Start-up has found what the link takes."""
    MAKE_WAY = auto()
    MADE_WAY = auto()
    RIVAL = auto()
    """The queue is somebody else's."""
    RIVAL_GONE = auto()


TRANSITIONS: Final[Mapping[Event, Mapping[Mode, Mode]]] = MappingProxyType(
    {
        Event.RESTART: dict.fromkeys(Mode, Mode.STARTUP),
        Event.FILLED: {Mode.STARTUP: Mode.STEADY, Mode.STARTUP_BESIDE: Mode.COMPETE},
        Event.MAKE_WAY: {Mode.STEADY: Mode.DRAIN, Mode.COMPETE: Mode.COMPETE_DRAIN},
        Event.MADE_WAY: {Mode.DRAIN: Mode.STEADY, Mode.COMPETE_DRAIN: Mode.COMPETE},
        Event.RIVAL: {Mode.STEADY: Mode.COMPETE, Mode.STARTUP: Mode.STARTUP_BESIDE},
        Event.RIVAL_GONE: {Mode.COMPETE: Mode.STEADY, Mode.STARTUP_BESIDE: Mode.STARTUP},
    }
)
"""The mode after an event, by the mode before it. What is not here cannot happen."""
