"""What a relay remembers of its decisions: of each client's link, what is not ordinary. Bounded in bytes. Pure."""

from typing import Final

from sern_core.vocabulary.trace import DecisionTrace
from sern_core.vocabulary.types import ClientName

CLIENT_BYTES: Final = 128 * 1024
"""What the trace of one client's link takes."""
MAX_CLIENTS: Final = 256
"""Clients whose links are traced; of more there is nothing to tell."""
CAPACITY: Final = 32
"""Records of one topic."""


class Traces:
    """Traces by the name of the client; off: nobody's is kept.

    A relay forwards what many clients send, so it does not record every step of every message as clients do.
    """

    def __init__(self, *, enabled: bool = True) -> None:
        self._enabled = enabled
        self._none = DecisionTrace(enabled=False)
        self._traces: dict[ClientName, DecisionTrace] = {}

    def of(self, client: ClientName) -> DecisionTrace:
        """The trace for the link of a client, which is new or was there before."""
        trace = self._traces.get(client)
        if trace is None:
            if not self._enabled or len(self._traces) >= MAX_CLIENTS:
                return self._none
            trace = self._traces[client] = DecisionTrace(CAPACITY, max_bytes=CLIENT_BYTES, steps=False)
        return trace

    def by_client(self) -> dict[ClientName, DecisionTrace]:
        """All that there are, by name."""
        return dict(sorted(self._traces.items()))

    def forget(self, client: ClientName) -> None:
        """The client is forgotten."""
        self._traces.pop(client, None)

    def validate(self) -> None:
        """Check bounds; raises AssertionError."""
        assert len(self._traces) <= MAX_CLIENTS, "more traces than clients may have"
        for trace in self._traces.values():
            trace.validate()
