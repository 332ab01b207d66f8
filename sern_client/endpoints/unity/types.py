"""Types by their names alone: a scene says no more of them."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sern_client.endpoints.unity import names
from sern_client.endpoints.unity.commands import shown
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_services, ros_types
from sern_runtime.ros_files import TypeFiles, installed_files
from sern_runtime.ros_types import TypeText

_CDR_HEADERS: Final = (b"\x00\x00", b"\x00\x01")
"""Plain CDR, big or little endian; two bytes of options follow."""
_CDR_HEADER_BYTES: Final = 4
_HINT: Final = "add the directory of its {} file to type_paths of the unity endpoint"

_log = logging.getLogger(__name__)


class SceneTypes:
    """Definitions from `paths`, from what is installed here, and from what everybody has."""

    def __init__(self, encoding: Encoding, paths: Sequence[Path]) -> None:
        self.encoding = encoding
        # What is installed here is of ROS 2; definitions of ROS 1 come from the paths.
        self._files = TypeFiles(paths) if encoding is Encoding.ROS1 else installed_files(paths)[0]

    def is_body(self, body: bytes) -> bool:
        """Whether bytes may be a message at all; what is in it is nobody's business here."""
        return self.encoding is Encoding.ROS1 or (len(body) >= _CDR_HEADER_BYTES and body[:2] in _CDR_HEADERS)

    def message(self, type_name: str) -> TypeText:
        """ConfigError when it is not known."""
        definition = self._files.message(type_name, self.encoding)
        if definition is None:
            hint = _HINT.format(".msg")
            raise ConfigError(f"the type {shown(names.their_type(type_name))} is not known here; {hint}")
        return TypeText(definition, ros_types.hash_of(type_name, definition, self.encoding))

    def knows_message(self, type_name: str) -> bool:
        try:
            return self._files.message(type_name, self.encoding) is not None
        except ConfigError as error:
            _log.debug("%s: %s", type_name, error)
            return False

    def service_definition(self, type_name: str, encoding: Encoding) -> str | None:
        """See `KnowsServiceTypes`."""
        return self._files.service(type_name, encoding)

    def service(self, type_name: str) -> TypeText:
        """ConfigError when it is not known."""
        definition = self._files.service(type_name, self.encoding)
        if definition is None:
            hint = _HINT.format(".srv")
            raise ConfigError(f"the service type {shown(names.their_type(type_name))} is not known here; {hint}")
        return ros_services.resolve(type_name, definition, self.encoding).text

    def answers_nothing(self, type_name: str, definition: str) -> bool:
        """Whether the response of a service has no fields; False where that is not known."""
        try:
            response = ros_services.resolve(type_name, definition, self.encoding).response
        except ConfigError as error:
            _log.debug("%s: %s", type_name, error)
            return False
        return all(field == ros_types.NO_FIELD for field, _ in response.store.fielddefs[response.name][1])
