"""What a registry takes of the owners of objects: ids, sizes and shares. Pure."""

import re
from dataclasses import dataclass
from typing import Final

from sern_core.vocabulary.errors import RefusedError
from sern_core.vocabulary.types import ClientName

_RESERVED: Final = re.compile(r".*@([a-z][a-z0-9_]{0,62})", re.DOTALL)


@dataclass(frozen=True, slots=True)
class ObjectLimits:
    """What the registry holds; beyond it an owner is refused by name. Every check raises RefusedError."""

    max_objects_per_owner: int = 4_096
    max_bytes_per_owner: int = 8 * 2**20  # of an owner's objects, as in max_total_bytes
    max_held_per_owner: int = 16 * 2**20  # of an owner's objects, as in max_held_bytes
    max_total_bytes: int = 64 * 2**20  # ids, type names, definitions, attributes and kept values
    max_held_bytes: int = 64 * 2**20  # references to larger values
    max_value_bytes: int = 4_096
    max_decoded_bytes: int = 16 * 2**20  # of a value that came encoded, when somebody asks for it
    max_definition_bytes: int = 256 * 2**10
    max_attributes: int = 64
    max_attribute_bytes: int = 4_096
    max_id_chars: int = 512
    deletions: int = 4_096  # length of the deletion log

    def check_id(self, object_id: str, owner: ClientName) -> None:
        """Refuse what is no id of an object, and one that is reserved for others."""
        if not object_id or len(object_id) > self.max_id_chars or not object_id.isprintable():
            raise RefusedError(
                "bad_id",
                f"{owner} may not put {object_id[:80]!r}: an id has 1 to {self.max_id_chars} printable characters",
            )
        reserved = _RESERVED.fullmatch(object_id)
        if reserved is not None and reserved[1] != owner:
            raise RefusedError(
                "not_owner",
                f"{owner} may not put {object_id[:80]}: ids that end in @{reserved[1]} belong to {reserved[1]}; "
                "choose another id",
            )

    def check_texts(
        self, object_id: str, owner: ClientName, definition_bytes: int, attributes: int, attribute_bytes: int
    ) -> None:
        """Refuse a definition or attributes that are too large, and too many attributes."""
        for what, size, limit in (
            ("bytes of definition", definition_bytes, self.max_definition_bytes),
            ("attributes", attributes, self.max_attributes),
            ("bytes of attributes", attribute_bytes, self.max_attribute_bytes),
        ):
            if size > limit:
                raise RefusedError(
                    "too_large", f"{owner} may not put {object_id[:80]}: {size} {what}; at most {limit} are taken"
                )

    def check_count(self, object_id: str, owner: ClientName, owned: int) -> None:
        """Refuse one more object of an owner who has as many as it may."""
        if owned >= self.max_objects_per_owner:
            raise RefusedError(
                "too_many_objects",
                f"{owner} may not put {object_id[:80]}: it has {self.max_objects_per_owner} objects, which is the "
                "limit; delete some",
            )

    def check_room(
        self, object_id: str, owner: ClientName, more_bytes: int, *, own_bytes: int, total_bytes: int
    ) -> None:
        """Refuse an object for which the owner's share has no room, or the registry."""
        for what, held_bytes, limit_bytes in (
            (f"{owner}'s objects hold", own_bytes, self.max_bytes_per_owner),
            ("the registry holds", total_bytes, self.max_total_bytes),
        ):
            if held_bytes + more_bytes > limit_bytes:
                raise RefusedError(
                    "registry_full",
                    f"{owner} may not put {object_id}: {what} {held_bytes} of {limit_bytes} bytes; "
                    "delete objects or shorten definitions",
                )
