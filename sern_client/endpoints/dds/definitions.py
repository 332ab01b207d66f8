"""Definitions for what discovery names by type and hash only."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services, ros_types
from sern_runtime.ros_files import installed_files
from sern_runtime.ros_types import TypeText

CDR = Encoding.CDR


class Definitions:
    """Types of the files in `type_paths`, of the installations of ROS 2 on this machine, and types known here.
    ConfigError says what to do when there is none."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._files = installed_files(paths)

    def message(self, type_name: str, type_hash: str = "") -> TypeText:
        """Definition and hash of a type: the one with this hash where one is given."""
        return _choose(type_name, type_hash, self._messages(type_name))

    def service_in(self, type_name: str, encoding: Encoding) -> str | None:
        """The definition text of a service as it is in `encoding`; None where it is unknown."""
        return next((text for files in self._files if (text := files.service(type_name, encoding)) is not None), None)

    def service(self, type_name: str, request_hash: str = "") -> TypeText:
        """The definition of a service, as `message` has those of messages; DDS tells it by the hash of its request."""
        return _choose(type_name, request_hash, self._services(type_name))

    def _messages(self, type_name: str) -> "Iterator[_Candidate]":
        for files in self._files:
            try:
                definition = files.message(type_name)
                if definition is not None:
                    text = TypeText(definition, ros_types.hash_of(type_name, definition, CDR))
                    yield text, text.type_hash
            except ConfigError as error:
                yield error
        known = ros_types.describe(type_name, CDR)
        if known is not None:
            yield known, known.type_hash

    def _services(self, type_name: str) -> "Iterator[_Candidate]":
        for files in self._files:
            try:
                definition = files.service(type_name)
                if definition is not None:
                    service = ros_services.resolve(type_name, definition, CDR)
                    yield service.text, service.request.text.type_hash
            except ConfigError as error:
                yield error


_Candidate = tuple[TypeText, str] | ConfigError
"""A definition with the hash that it is found by, or why there is none in that place."""


def _choose(type_name: str, type_hash: str, candidates: Iterable[_Candidate]) -> TypeText:
    """The first that fits; what comes after it is not read."""
    errors: list[ConfigError] = []
    hashes: dict[str, None] = {}
    for candidate in candidates:
        if isinstance(candidate, ConfigError):
            if not type_hash:  # the nearest place counts then, and it is to be put right
                raise candidate
            errors.append(candidate)
            continue
        text, known_hash = candidate
        if not type_hash or known_hash == type_hash:
            return text
        hashes[known_hash] = None
    if errors:
        raise errors[0]
    if not hashes:
        raise ConfigError(
            f"type {type_name} is unknown here; add the directory with its definition to the endpoint's type_paths"
        )
    known = " and ".join(hashes)
    raise ConfigError(
        f"type {type_name}: offered with hash {type_hash}, but the definition known here has {known}; "
        "add the directory with the right version to the endpoint's type_paths"
    )
