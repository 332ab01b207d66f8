"""Subscribers that come back to a topic which has ended and begun anew.

A node whose connection ends connects again by itself, roscpp after 100 ms, also where the topic has ended and the
master is just about to say so. If the topic has begun anew meanwhile, what it is sent then is thrown away unread when
the master's word comes, with that connection. The next word of the master is that the topic is here again: the node
asks where to connect, and that connection is the one to serve.
"""

import asyncio
from collections import OrderedDict
from typing import Final

TOLD_S: Final = 2.0
"""How long after its end a topic's subscribers are expected to hear of it. Who has not asked by then is served all the
same."""
MAX_KEPT: Final = 1024
"""Subscribers that are remembered, of all topics."""


class Returning:
    """Who has been served, by topic and name: the last `MAX_KEPT`, while the endpoint lives."""

    def __init__(self) -> None:
        self._ended_s: OrderedDict[tuple[str, str], float | None] = OrderedDict()  # None: the topic has not ended

    def served(self, topic: str, caller: str) -> None:
        """A subscriber has connected."""
        self._ended_s[topic, caller] = None
        self._ended_s.move_to_end((topic, caller))
        if len(self._ended_s) > MAX_KEPT:
            self._ended_s.popitem(last=False)

    def ended(self, topic: str) -> None:
        """The master is told that the topic has ended, and will tell its subscribers."""
        now = asyncio.get_running_loop().time()
        for key in self._ended_s:
            if key[0] == topic:
                self._ended_s[key] = now

    def asked(self, topic: str, caller: str) -> None:
        """A subscriber has asked where to connect, so it knows of the topic that is here now."""
        if (topic, caller) in self._ended_s:
            self._ended_s[topic, caller] = None

    def too_early(self, topic: str, caller: str) -> bool:
        """Whether a subscriber that connects has not heard yet that the topic which it knows has ended."""
        ended_s = self._ended_s.get((topic, caller))
        return ended_s is not None and asyncio.get_running_loop().time() - ended_s < TOLD_S
