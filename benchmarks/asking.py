"""What daemons answer over HTTP. `http` is an address as in their file, such as 127.0.0.1:9480."""

import json
import urllib.request
from typing import Any, Final

PATIENCE_S: Final = 5.0


def get(http: str, path: str) -> bytes:
    """The answer; empty while there is none."""
    try:
        with urllib.request.urlopen(f"http://{http}{path}", timeout=PATIENCE_S) as answer:
            return bytes(answer.read())
    except OSError:
        return b""


def ready(http: str) -> bool:
    """Whether it says so; a 503 is an OSError of urllib's."""
    return bool(get(http, "/readyz"))


def count(http: str, name: str) -> float:
    """A metric, over all its labels; 0 before the daemon answers."""
    lines = get(http, "/metrics").decode().splitlines()
    return sum(float(line.split()[-1]) for line in lines if line.startswith((f"{name} ", f"{name}{{")))


def delivered(http: str) -> dict[str, int]:
    """How many messages a client has been given of each topic; empty before it answers."""
    answer = get(http, "/api/topics")
    rows: dict[str, dict[str, Any]] = json.loads(answer) if answer else {}
    return {topic: int(row["delivered"]) for topic, row in rows.items() if row["direction"] == "receive"}
