"""Definitions for what discovery names by type and hash only."""

from collections.abc import Iterable
from pathlib import Path

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services, ros_types
from sern_runtime.ros_files import TypeFiles
from sern_runtime.ros_types import TypeText

CDR = Encoding.CDR


class Definitions:
    """Types of the files in `type_paths`, and types known here. ConfigError says what to do when there is none."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._files = TypeFiles(paths)

    def message(self, type_name: str, type_hash: str = "") -> TypeText:
        """Definition and hash of a type: the one with this hash where one is given."""
        found: list[tuple[TypeText, str]] = []
        definition = self._files.message(type_name)
        if definition is not None:
            text = TypeText(definition, ros_types.hash_of(type_name, definition, CDR))
            found.append((text, text.type_hash))
        known = ros_types.describe(type_name, CDR)
        if known is not None:
            found.append((known, known.type_hash))
        return _choose(type_name, type_hash, found)

    def service_in(self, type_name: str, encoding: Encoding) -> str | None:
        """The definition text of a service as it is in `encoding`; None where it is unknown."""
        return self._files.service(type_name, encoding)

    def service(self, type_name: str, request_hash: str = "") -> TypeText:
        """The definition of a service, as `message` has those of messages; DDS tells it by the hash of its request."""
        found: list[tuple[TypeText, str]] = []
        definition = self._files.service(type_name)
        if definition is not None:
            service = ros_services.resolve(type_name, definition, CDR)
            found.append((service.text, service.request.text.type_hash))
        return _choose(type_name, request_hash, found)


def _choose(type_name: str, type_hash: str, found: list[tuple[TypeText, str]]) -> TypeText:
    if not found:
        raise ConfigError(
            f"type {type_name} is unknown here; add the directory with its definition to the endpoint's type_paths"
        )
    for text, known_hash in found:
        if not type_hash or known_hash == type_hash:
            return text
    known = " and ".join(dict.fromkeys(known_hash for _, known_hash in found))
    raise ConfigError(
        f"type {type_name}: offered with hash {type_hash}, but the definition known here has {known}; "
        "add the directory with the right version to the endpoint's type_paths"
    )
