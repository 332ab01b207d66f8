"""The types of an installation: Python classes by name, and their definitions from the files beside them."""

from importlib import import_module
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_installation, ros_services, ros_types
from sern_runtime.ros_files import TypeFiles

_ACTION_PARTS: Final = {
    "_SendGoal": "SendGoalService",
    "_GetResult": "GetResultService",
    "_FeedbackMessage": "FeedbackMessage",
}


class Interfaces:
    """Classes are loaded when they are asked for. ConfigError, in one line, where there is none."""

    def __init__(self, paths: tuple[Path, ...]) -> None:
        self.files = TypeFiles(paths, share=_share)

    def message(self, user: str, type_name: str) -> type[Any]:
        """The class of a message type that the topic `user` has."""
        return _load(user, type_name, "message", ("msg", "action"))

    def service(self, user: str, type_name: str) -> type[Any]:
        """The class of a service type that the service `user` has."""
        return _load(user, type_name, "service", ("srv", "action"))

    def message_text(self, type_name: str) -> tuple[str, str]:
        """Definition and hash; empty where it is unknown. ConfigError where files cannot be read."""
        definition = self.files.message(type_name) or ""
        return definition, ros_types.hash_of(type_name, definition, Encoding.CDR) if definition else ""

    def service_text(self, type_name: str) -> tuple[str, str]:
        """Definition and hash; empty where it is unknown. ConfigError where files cannot be read."""
        definition = self.files.service(type_name) or ""
        if not definition:
            return "", ""
        text = ros_services.resolve(type_name, definition, Encoding.CDR).text
        return text.definition, text.type_hash


def _load(user: str, type_name: str, what: str, kinds: tuple[str, ...]) -> type[Any]:
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] not in kinds or not all(part.isidentifier() for part in parts):
        raise ConfigError(f"{user}: {type_name} is no type of a {what}")
    package, kind, name = parts
    try:
        module = import_module(f"{package}.{kind}")
        loaded = _of_action(module, name) if kind == "action" else getattr(module, name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{user}: {type_name} is not in this ROS 2 installation ({ros_types.one_line(error)}); "
            "source the workspace that has it"
        ) from None
    if not isinstance(loaded, type):
        raise ConfigError(f"{user}: {type_name} is no type in this ROS 2 installation")
    return loaded


def _of_action(module: Any, name: str) -> Any:
    for suffix, part in _ACTION_PARTS.items():
        if name.endswith(suffix):
            return getattr(getattr(module, name.removesuffix(suffix)).Impl, part)
    raise AttributeError(f"{name} is no part of an action that is sent")


def _share(package: str) -> Path | None:
    """The files of a package that Python can import here."""
    try:
        file = import_module(package).__file__
    except ImportError:
        return None
    return None if file is None else ros_installation.share_of(file, package)
