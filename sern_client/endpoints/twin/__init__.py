"""The twins of robots as an endpoint: it hears their poses and plans, and publishes where they are by now."""
