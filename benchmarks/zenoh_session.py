"""A zenoh session between two processes of a benchmark, for any Python: it imports nothing else of the project."""

import json
from collections.abc import Sequence
from typing import Any


def open_session(locators: Sequence[str], *, listens: bool) -> Any:
    """A peer that finds nobody but who is at the `locators` (`tcp/host:port`), without shared memory: the processes
    stand for two hosts. Several locators are several links to one peer. ImportError without zenoh."""
    import zenoh

    config = zenoh.Config()
    settings: dict[str, object] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_links": len(locators),
        "listen/endpoints": list(locators) if listens else [],
        "connect/endpoints": [] if listens else list(locators),
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
