"""One ROS 2 domain through rclpy: a context of its own, a node in it, and the thread that executes its callbacks.

A callback that fails costs what it was about. A thread that ends although nobody asked it to, since its executor or
context was shut down by something else in this process, is the end of this domain alone, and said once.
"""

import asyncio
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from threading import Event, Thread
from typing import TYPE_CHECKING, Final

from sern_client.endpoints.common.handover import Handover
from sern_client.endpoints.common.saying import SayOnce
from sern_client.endpoints.rclpy.options import RclpyOptions
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime import clock, ros_installation, ros_types

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.node import Node

    from sern_client.endpoints.rclpy.executor import Executor

ENCLAVE: Final = "/sern"
"""The enclave of our nodes, by which SERN endpoints know each other: what their nodes publish came over a link."""
MAX_PAUSE_S: Final = 1.0
"""The longest pause after a callback that failed, where one follows the other."""
CALM_S: Final = 1.0
"""After so long without a failure the next one is not followed by a pause."""
REST_S: Final = 0.0001
"""How long the thread of the executor rests when it has woken the event loop: else it has the interpreter while it
asks everything for news, some 0.3 ms that the loop would wait."""

_log = logging.getLogger(__name__)


@contextmanager
def refused(problem: str) -> Iterator[None]:
    """ConfigError, in one line, where rclpy does not give what is asked for inside; its errors are of many types."""
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:  # noqa: BLE001  (raised as one that whoever asks expects)
        raise ConfigError(f"{problem}: {ros_types.one_line(error)}") from None


class Domain:
    """`ended` is called on the event loop when nothing is heard from the domain any more, though `close` was not
    called."""

    def __init__(self, options: RclpyOptions, say_once: SayOnce, ended: Callable[[], None]) -> None:
        self.problem: str | None = "it was not joined"
        """Why nothing can be done there; None: all is well."""
        self.handover_dropped = 0
        self._options = options
        self._say_once = say_once
        self._ended = ended
        self._closing = Event()
        self._open: _Open | None = None

    def join(self) -> None:
        """ConfigError where rclpy is not to be had, or the domain cannot be joined."""
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.node import Node

            from sern_client.endpoints.rclpy.executor import Executor
        except ImportError as error:
            raise ConfigError(
                f"endpoint rclpy: rclpy cannot be imported ({ros_types.one_line(error)}); {ros_installation.remedy()}"
            ) from None
        self._closing.clear()
        context = Context()
        with refused(f"endpoint rclpy: {self.name} cannot be joined"), ExitStack() as failed:
            args = [] if self._options.as_node else ["--ros-args", "--enclave", ENCLAVE]
            rclpy.init(args=args, context=context, domain_id=self._options.domain)
            failed.callback(rclpy.shutdown, context=context)
            node = Node(
                self._options.node_name, context=context, use_global_arguments=False, enable_rosout=False,
                start_parameter_services=False,
            )  # fmt: skip
            executor = Executor(node)
            failed.pop_all()
        handover = Handover(
            asyncio.get_running_loop(), max_bytes=self._options.max_buffer_bytes, rest=lambda: time.sleep(REST_S)
        )
        thread = Thread(target=self._spin, args=(executor, handover), name=f"rclpy-{self.name}", daemon=True)
        self._open = _Open(context, node, executor, handover, thread)
        self.problem = None
        thread.start()

    async def close(self) -> None:
        """Leave; no thread and no node stays behind."""
        import rclpy

        if self._open is None:
            return
        left, self._open = self._open, None
        self.problem = "it was left"
        self._closing.set()
        await asyncio.to_thread(left.executor.shutdown)
        await asyncio.to_thread(left.thread.join)
        left.handover.close()
        self.handover_dropped += left.handover.dropped
        await asyncio.to_thread(_end, left, rclpy.shutdown)

    @property
    def name(self) -> str:
        """What messages call it."""
        number = self._options.domain
        return f"domain {os.environ.get('ROS_DOMAIN_ID', '') or '0'}" if number is None else f"domain {number}"

    @property
    def alive(self) -> bool:
        return self.problem is None

    @property
    def node(self) -> "Node":
        """UsageError before `join` and after `close`."""
        return self._joined().node

    @property
    def handover(self) -> Handover:
        return self._joined().handover

    @property
    def dropped(self) -> int:
        """Messages and requests that went because the event loop was behind."""
        return self.handover_dropped + (0 if self._open is None else self._open.handover.dropped)

    def _joined(self) -> "_Open":
        if self._open is None:
            raise UsageError("the rclpy endpoint is not running")
        return self._open

    def _spin(self, executor: "Executor", handover: Handover) -> None:
        """Runs in the thread."""
        from rclpy.executors import ExternalShutdownException

        pause_s, failed_s = 0.0, clock.now()
        while not self._closing.is_set():
            try:
                executor.spin()
                break
            except ExternalShutdownException:
                break
            except Exception as error:  # noqa: BLE001  (of one callback: the others are to be called)
                handover.news(lambda error=error: self._failed(error))  # type: ignore[misc]
                now = clock.now()
                pause_s = 0.0 if now - failed_s > CALM_S else min(MAX_PAUSE_S, max(0.001, 2 * pause_s))
                failed_s = now
                self._closing.wait(pause_s)
        if not self._closing.is_set():
            handover.news(self._gone)

    def _failed(self, error: Exception) -> None:
        self._say_once(f"{self.name}: a callback of rclpy failed: {ros_types.one_line(error)}", error=error)

    def _gone(self) -> None:
        if self._open is None:
            return
        which = "executor" if self._open.context.ok() else "context"
        self.problem = f"the {which} of rclpy was shut down by something else in this process"
        _log.error("%s: %s; nothing is bridged there until the client is started again", self.name, self.problem)
        self._ended()


class _Open:
    def __init__(
        self, context: "Context", node: "Node", executor: "Executor", handover: Handover, thread: Thread
    ) -> None:
        self.context = context
        self.node = node
        self.executor = executor
        self.handover = handover
        self.thread = thread


def _end(left: _Open, shutdown: Callable[..., None]) -> None:
    try:
        left.node.destroy_node()
    finally:
        if left.context.ok():
            shutdown(context=left.context)
