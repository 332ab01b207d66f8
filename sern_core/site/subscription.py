"""What this site wants of the others, told to the relay in envelopes that hold it."""

from collections.abc import Sequence

from sern_core.link.control_stream import ControlStream
from sern_core.vocabulary.types import ClientName
from sern_core.wire import framing
from sern_core.wire.announce import MAX_STRINGS


class Subscription:
    """Set `patterns`, then `send`; and `send` again in every session that begins."""

    def __init__(self, control: ControlStream) -> None:
        self.patterns: tuple[str, ...] = ()
        """Full-match patterns of global names."""
        self._control = control

    def send(self, now: float, known: Sequence[ClientName] = ()) -> None:
        """Tell the relay; what it had of us before goes. `known`: of whom it is asked whether they are here."""
        for start in range(0, len(known), MAX_STRINGS):
            names = list(known[start : start + MAX_STRINGS])
            self._control.send({"t": "subscribe", "patterns": [], "more": True, "known": names}, now=now)
        batch: list[str] = []
        batch_bytes = 0
        for pattern in self.patterns:
            # An envelope holds 4 KiB: long patterns travel in more parts.
            nbytes = len(pattern) + 4
            if len(batch) == MAX_STRINGS or batch_bytes + nbytes > framing.MAX_ENVELOPE_BYTES // 2:
                self._control.send({"t": "subscribe", "patterns": batch, "more": True}, now=now)
                batch, batch_bytes = [], 0
            batch.append(pattern)
            batch_bytes += nbytes
        self._control.send({"t": "subscribe", "patterns": batch, "more": False, "peers": True, "keys": True}, now=now)
