"""The section of a client file for cross-reality objects of others."""

from typing import Final, Literal

from sern_core.site.object_mirror import MAX_WANTS, Selection
from sern_core.vocabulary.types import ObjectKind
from sern_runtime.config.base import Pattern, Section

TOPIC_KINDS: Final = (ObjectKind.TOPIC, ObjectKind.TRANSFORM, ObjectKind.PATCH, ObjectKind.COMMAND)
"""The kinds of objects that stand for topics."""
MAX_SELECTIONS: Final = MAX_WANTS - 2 - len(TOPIC_KINDS)
"""Beside them a client selects what its scene needs, and topics to look at."""


class ObjectSelection(Section):
    """Cross-reality objects of others that this site wants."""

    kind: (
        Literal["topic", "transform", "node", "robot", "obstacle", "terrain", "patch", "discrepancy", "command"] | None
    ) = None
    """Only objects of this kind; null: of any."""
    match: Pattern = ".*"
    """Only objects whose whole id matches, such as twin/.* or /jackal1/odom@jackal1."""

    def selection(self) -> Selection:
        return Selection(None if self.kind is None else ObjectKind(self.kind), self.match)
