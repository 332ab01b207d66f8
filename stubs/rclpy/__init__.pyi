# The part of rclpy (ROS 2 Jazzy) that sern_client/endpoints/rclpy uses, for the type checker.
from collections.abc import Sequence

from rclpy.context import Context

def init(
    *, args: Sequence[str] | None = None, context: Context | None = None, domain_id: int | None = None
) -> None: ...
def shutdown(*, context: Context | None = None) -> None: ...
