"""The executor of a domain, to be imported where rclpy is there."""

from collections.abc import Callable
from typing import Any

from rclpy.executors import SingleThreadedExecutor


class Executor(SingleThreadedExecutor):
    """Does at once what is to be done when a response is there. rclpy makes a task of it, for which it first asks the
    middleware anew about everything that there is; what is done here takes less than that."""

    def create_task(self, callback: Callable[..., object], *args: Any, **kwargs: Any) -> None:
        """Call it now, in the thread that executes callbacks: nothing of ours waits for the task."""
        callback(*args, **kwargs)
