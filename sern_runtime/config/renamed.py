"""Configuration keys and values that once had another name, so that an old file is told the new one."""

from collections.abc import Collection
from typing import Final

RENAMED_KEYS: Final = {
    "express": "priority_connections",
    "heed_sern": "accept_bridged",
}
"""The old name of a key and the new one, wherever the new one is accepted."""
RENAMED_VALUES: Final = {
    ("algorithm", "delay"): "hybrid",
}
"""The same of what a key may be."""


def renamed_key(key: str, accepted: Collection[str]) -> str | None:
    """What `key` is called now in a section that accepts these keys; None: it never was a key there."""
    new = RENAMED_KEYS.get(key)
    return new if new in accepted else None


def renamed_value(key: str, value: str, accepted: Collection[str]) -> str | None:
    """What `value` is called now where `key` accepts these values; None: it never was accepted there."""
    new = RENAMED_VALUES.get((key, value))
    return new if new in accepted else None
