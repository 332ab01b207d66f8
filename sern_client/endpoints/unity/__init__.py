"""Unity scenes at a site: the protocol of ROS-TCP-Connector."""
