"""What the window from delay and rate is doing, and what makes it do something else.

        filled            stuck                      restart: from anywhere to start-up
STARTUP ------> STEADY <----------> COMPETE        swings: STEADY to VARIABLE and back
   | rival       ^  |     gone       ^  |
   v             |  v make way       |  v make way
STARTUP_BESIDE   DRAIN               COMPETE_DRAIN
"""

from collections.abc import Mapping
from enum import Enum, auto
from types import MappingProxyType
from typing import Final, NamedTuple


class Mode(NamedTuple):
    """What the window is doing. While it competes a rival keeps the queue, and the window follows CUBIC."""

    starting: bool
    """It goes where the trains of packets point."""
    draining: bool
    """It makes way for a round trip, to see the path empty; while it competes, whether the rival has gone."""
    competing: bool
    varying: bool = False
    """It follows a rate that swings, with a queue that shows it."""


STEADY: Final = Mode(starting=False, draining=False, competing=False)
"""It follows the queue."""
VARIABLE: Final = Mode(starting=False, draining=False, competing=False, varying=True)
STARTUP: Final = Mode(starting=True, draining=False, competing=False)
DRAIN: Final = Mode(starting=False, draining=True, competing=False)
COMPETE: Final = Mode(starting=False, draining=False, competing=True)
COMPETE_DRAIN: Final = Mode(starting=False, draining=True, competing=True)
STARTUP_BESIDE: Final = Mode(starting=True, draining=False, competing=True)
"""It started again before a queue was judged that was found to be a rival's."""
MODES: Final = (STEADY, VARIABLE, STARTUP, DRAIN, COMPETE, COMPETE_DRAIN, STARTUP_BESIDE)


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
    SWINGS = auto()
    """The rate of the link goes up and down all the time."""
    SETTLED = auto()
    """It does no longer."""


TRANSITIONS: Final[Mapping[Event, Mapping[Mode, Mode]]] = MappingProxyType(
    {
        Event.RESTART: dict.fromkeys(MODES, STARTUP),
        Event.FILLED: {STARTUP: STEADY, STARTUP_BESIDE: COMPETE},
        Event.MAKE_WAY: {STEADY: DRAIN, COMPETE: COMPETE_DRAIN},
        Event.MADE_WAY: {DRAIN: STEADY, COMPETE_DRAIN: COMPETE},
        Event.RIVAL: {STEADY: COMPETE, STARTUP: STARTUP_BESIDE},
        Event.RIVAL_GONE: {COMPETE: STEADY, STARTUP_BESIDE: STARTUP},
        Event.SWINGS: {STEADY: VARIABLE},
        Event.SETTLED: {VARIABLE: STEADY},
    }
)
"""The mode after an event, by the mode before it. What is not here cannot happen."""
