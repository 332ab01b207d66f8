"""ROS 2 through rclpy, where an installation is sourced: whatever its middleware is, services and actions too.

domain          one context of rclpy, with its node, and the thread that executes its callbacks
interfaces      Python classes and definitions of the types that the installation has
qos             what publishers offer, and what follows for ours
echoes          which of what is heard we have published ourselves
graph           what there is in a domain, looked at again and again
topics          a topic on its way to the link, and from it
services        services, both ways; those of actions are services
endpoint        all of it together: `RclpyEndpoint`
"""

from sern_client.endpoints.rclpy.endpoint import RclpyEndpoint
from sern_client.endpoints.rclpy.options import RclpyOptions

__all__ = ["RclpyEndpoint", "RclpyOptions"]
