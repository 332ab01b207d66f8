"""Goals of ROS 2 that are to be cancelled, tried until it is done: the link may be away, or the server's site."""

import asyncio
import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final

from sern_client.action_conversion import bodies
from sern_client.action_conversion.bodies import GoalInfo
from sern_client.action_conversion.goals import MAX_LIVE
from sern_client.endpoints.base import ServiceHandler
from sern_client.endpoints.common.calls import Tasks
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_runtime import clock

CANCEL_S: Final = 600.0
"""How long it is tried to cancel a goal."""
CANCEL_AGAIN_S: Final = (1.0, 30.0)
"""First and longest pause before a goal that was not cancelled is cancelled again."""
MAX_CANCELLING: Final = 2 * MAX_LIVE

_log = logging.getLogger(__name__)


class Cancelling:
    """The cancellings of one action. They go on while nodes here do not see the action, until `stop`.

    `calls`: the services of the action by the last part of their names, as they are now. `done` is called when one is
    over.
    """

    def __init__(self, name: str, calls: Mapping[str, ServiceHandler], done: Callable[[], None]) -> None:
        self.count = 0
        """How many are under way."""
        self._name = name
        self._calls = calls
        self._done = done
        self._tasks = Tasks(MAX_CANCELLING)

    def begin(self, info: GoalInfo, wanted: Callable[[], bool], *, once: bool = False) -> None:
        """Cancel what `info` means, again and again while it is `wanted`, or `once`."""
        if self._tasks.full:
            _log.error("%s: a goal is not cancelled: %d others are to be already", self._name, MAX_CANCELLING)
            return
        self.count += 1
        self._tasks.begin(self._cancel(bodies.cancel_request(info), wanted, once=once), name="cancel-goal")

    async def stop(self) -> None:
        self._tasks.cancel()
        await self._tasks.ended()

    async def _cancel(self, request: bytes, wanted: Callable[[], bool], *, once: bool) -> None:
        """Ask until the goal's server takes it: who refuses it, the link or the server, is not told."""
        until_s, pause_s = clock.now() + CANCEL_S, CANCEL_AGAIN_S[0]
        try:
            while clock.now() < until_s and wanted():
                with suppress(ServiceError, ConfigError):
                    handler = self._calls.get("cancel_goal")
                    if handler is not None and bodies.cancel_code(await handler(request)) != bodies.REJECTED:
                        return
                if once:
                    return
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, CANCEL_AGAIN_S[1])
        finally:
            self.count -= 1
            self._done()
