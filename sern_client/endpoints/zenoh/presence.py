"""Whether requests for a service would reach anybody.

A server is known by its token, and reached through its queryable. Which of the two is known here first is chance where
a node declares its token first, and a query that nothing matches is over at once, without an answer.
"""

import asyncio
from typing import Any

from sern_client.endpoints.zenoh.session import ZenohSession


class Presence:
    """Watches the queryables that match `key`, from now until `close`."""

    def __init__(self, session: ZenohSession, key: str) -> None:
        zenoh, handover = session.zenoh, session.handover
        self._session = session
        self._there = asyncio.Event()
        self._querier: Any = session.opened.declare_querier(key, target=zenoh.QueryTarget.BEST_MATCHING)

        def changed(_status: Any) -> None:  # in a thread of zenoh's
            handover.news(self._look)

        self._listener: Any = self._querier.declare_matching_listener(zenoh.handlers.Callback(changed))
        self._look()

    def _look(self) -> None:
        if self._querier is None:
            return
        if self._querier.matching_status.matching:
            self._there.set()
        else:
            self._there.clear()

    async def wait(self) -> bool:
        """Return True once a request would reach a queryable, False when `close` is called before."""
        await self._there.wait()
        return self._querier is not None

    def close(self) -> None:
        """Idempotent. Before the session ends."""
        listener, querier, self._querier = self._listener, self._querier, None
        if querier is None:
            return

        def undeclare() -> None:
            listener.undeclare()
            querier.undeclare()

        self._session.put(undeclare, 0)
        self._there.set()
