"""The executor of a domain, to be imported where rclpy is there."""

from collections.abc import Callable
from threading import Event, Lock
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node


class Executor(SingleThreadedExecutor):
    """Executes the callbacks of one node.

    Does at once what is to be done when a response is there. rclpy makes a task of it, for which it first asks the
    middleware anew about everything that there is; what is done here takes less than that.

    Its shutdown ends the thread that spins first. That of rclpy destroys what would wake that thread, which then waits
    for ever where it was about to.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self.add_node(node)
        self._leaving = node.create_guard_condition(self._leave)
        self._lock = Lock()
        self._left = False
        self._idle = Event()
        self._idle.set()

    def create_task(self, callback: Callable[..., object], *args: Any, **kwargs: Any) -> None:
        """Call it now, in the thread that executes callbacks: nothing of ours waits for the task."""
        callback(*args, **kwargs)

    def spin(self) -> None:
        with self._lock:
            if self._left:
                return
            self._idle.clear()
        try:
            super().spin()
        finally:
            self._idle.set()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Called from any other thread than the one that spins."""
        with self._lock:
            self._left = True
        if not self._idle.is_set():
            self._leaving.trigger()  # it stays triggered until the thread waits
            if not self._idle.wait(timeout_sec):
                return False
        return bool(super().shutdown(timeout_sec))

    def _leave(self) -> None:
        """Called in the thread that spins, where shutting down is safe."""
        super().shutdown(0)
