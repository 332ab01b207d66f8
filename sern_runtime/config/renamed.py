"""Configuration keys that once had another name, so that an old file is told the new one."""

from collections.abc import Collection
from typing import Final

RENAMED_KEYS: Final = {
    "express": "priority_connections",
    "heed_sern": "accept_bridged",
}
"""The old name of a key and the new one, wherever the new one is accepted."""


def renamed_key(key: str, accepted: Collection[str]) -> str | None:
    """What `key` is called now in a section that accepts these keys; None: it never was a key there."""
    new = RENAMED_KEYS.get(key)
    return new if new in accepted else None
