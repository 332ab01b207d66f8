"""Topics whose last publisher has gone while reliable messages of it were on their way to the relay.

A node that publishes a few messages and ends is usual (`rostopic pub -1`, `rosbag play`). The stream goes on until the
relay has got them all, or for `LEAVE_S`: what has not arrived then is reported as ever. What subscribers behind the
relay are still owed is the relay's to keep. The streams of one topic (a grid and its changes) end together. Of durable
topics nothing is given up (`durable.py`).
"""

from collections.abc import Callable
from typing import Final

from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.types import TopicName

LEAVE_S: Final = 10.0
"""Longest wait for what a topic that ended still has to deliver. It ends early when the topic comes back."""


class Leaving:
    """`withdraw` ends a stream. Call `look` about once a second."""

    def __init__(self, withdraw: Callable[[OutChannel], None]) -> None:
        self._withdraw = withdraw
        self._until_s: dict[TopicName, tuple[tuple[OutChannel, ...], float]] = {}

    def leave(self, name: TopicName, *channels: OutChannel, now: float) -> None:
        """The local topic has no publisher any more; `channels` are its streams, withdrawn in this order."""
        self._until_s[name] = (channels, now + LEAVE_S)
        if not any(map(_owes, channels)):
            self.come_back(name)

    def come_back(self, name: TopicName) -> None:
        """The topic has a publisher again, whose messages are another stream."""
        channels, _ = self._until_s.pop(name, ((), 0.0))
        for channel in channels:
            self._withdraw(channel)

    def look(self, *, now: float) -> None:
        """End what has been sent, or has taken too long."""
        for name, (channels, until_s) in list(self._until_s.items()):
            if now >= until_s or not any(map(_owes, channels)):
                self.come_back(name)

    def close(self) -> None:
        self._until_s.clear()


def _owes(channel: OutChannel) -> bool:
    """Whether something of it must still get to the relay."""
    here = channel.reliable and not channel.spec.durable
    return here and channel.wanted is not False and bool(channel.queue or channel.flying)
