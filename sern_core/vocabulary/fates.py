"""What becomes of single messages at one end of a hop, for audits: who wants to know it hangs a `Fates` on the link."""

from typing import Protocol

from sern_core.vocabulary.message import Message, StreamInfo
from sern_core.vocabulary.types import ClientName, DropReason


class Fates(Protocol):
    """Is told of every drop that is counted, with the message's seq. It must not raise."""

    def dropped(self, stream: StreamInfo, seq: int, reason: DropReason, peer: ClientName) -> None:
        """A message to `peer` was given up."""

    def discarded(self, stream: StreamInfo, seq: int, reason: DropReason, peer: ClientName) -> None:
        """A message from `peer` arrived, or a part of it, and goes no further. Duplicates are not reported."""

    def received(self, stream: StreamInfo, message: Message, peer: ClientName) -> None:
        """At a relay: a message from `peer` has had its turn, and goes on to all who get it."""

    def held(self, stream: StreamInfo, seq: int, peer: ClientName, *, exposed: bool) -> None:
        """A message waits for `peer`, or (`peer` is empty) for whoever comes. `exposed`: it was sent whole."""
