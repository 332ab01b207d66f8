"""What people ask to be fetched, as files of a folder: who may write there may ask, and it outlives this process."""

import json
import logging
import os
import secrets
from pathlib import Path
from typing import Final, NamedTuple

from sern_core.site.spool import EVER, Window
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import TopicName

FOLDER: Final = "orders"
SUFFIX: Final = ".json"
MAX_ORDERS: Final = 100
MAX_ORDER_BYTES: Final = 4096

_log = logging.getLogger(__name__)


class Order(NamedTuple):
    """Messages of a topic that somebody wants, by their stamps."""

    topic: TopicName
    window: Window


def place(directory: Path, order: Order) -> Path:
    """Ask for it. Returns the file, which is there until it is done. Raises OSError."""
    folder = directory / FOLDER
    name = f"{secrets.token_hex(8)}{SUFFIX}"
    made = folder / f".{name}"
    content = {"topic": order.topic, "from_ns": order.window.from_ns, "to_ns": order.window.to_ns}
    made.write_text(json.dumps(content) + "\n", encoding="utf-8")
    return made.rename(folder / name)


def look(directory: Path, said: set[str]) -> dict[Path, Order]:
    """The orders there are, at most `MAX_ORDERS`. One that is none is said, once for each name, and left. Raises
    OSError."""
    found: dict[Path, Order] = {}
    with os.scandir(directory / FOLDER) as entries:
        for entry in entries:
            if len(found) >= MAX_ORDERS:
                break
            if entry.name.startswith(".") or not entry.name.endswith(SUFFIX):
                continue
            path = Path(entry.path)
            try:
                found[path] = _read(path)
            except FileNotFoundError:
                continue
            except (OSError, ValueError, KeyError, TypeError) as error:
                if entry.name not in said and len(said) < MAX_ORDERS:
                    said.add(entry.name)
                    _log.error("%s is no order of `sern spool fetch` (%s); delete it", path, error)
    return found


def _read(path: Path) -> Order:
    """Raises OSError, ValueError, KeyError or TypeError."""
    with path.open("rb") as file:
        content = json.loads(file.read(MAX_ORDER_BYTES))
    topic, from_ns, to_ns = content["topic"], content["from_ns"], content["to_ns"]
    if not (isinstance(topic, str) and isinstance(from_ns, int) and isinstance(to_ns, int)):
        raise TypeError("a name and two numbers are needed")
    problem = name_problem(topic)
    if problem is not None:
        raise ValueError(f"its topic {problem}")
    least, most = EVER
    if not least <= from_ns <= to_ns <= most:
        raise ValueError("it ends before it begins")
    return Order(TopicName(topic), Window(from_ns, to_ns))
