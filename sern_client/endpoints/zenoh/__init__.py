"""ROS 2 over zenoh (rmw_zenoh)."""
