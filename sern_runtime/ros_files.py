"""Definitions from .msg and .srv files, for types that not every installation has.

ROS 2 middleware announces a topic with the name and hash of its type, never with the definition. What is not known here
comes from directories a person names: a ROS install's `share`, a workspace's `src`, or a folder laid out alike
(`PACKAGE/msg/Name.msg`, at any depth).
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from rosbags.typesys import TypesysError, get_types_from_msg

from sern_core.errors import ConfigError
from sern_core.types import Encoding
from sern_runtime import ros_services, ros_types

_SEPARATOR: Final = "=" * 80 + "\n"
_DIVIDER: Final = "---"


class TypeFiles:
    """Definition texts by type name. The directories are searched once, when the first type is asked for."""

    def __init__(self, paths: Iterable[Path] = ()) -> None:
        self._paths = tuple(paths)
        self._files: dict[str, Path] | None = None

    def message(self, type_name: str, encoding: Encoding = Encoding.CDR) -> str | None:
        """The concatenated definition of a message type, from files or as it is known here; None where it is unknown.

        ConfigError when a file cannot be read, or uses a type that is nowhere.
        """
        name = ros_types.canonical(type_name)
        own = self._read(name)
        if own is None:
            known = ros_types.describe(name, encoding)
            return None if known is None else known.definition
        return own.rstrip("\n") + "\n" + self._below(name, [own], encoding)

    def service(self, type_name: str, encoding: Encoding = Encoding.CDR) -> str | None:
        """The definition of a service type (request, `---`, response, the types they use); None where it is unknown.

        Raises as `message` does.
        """
        own = self._read(type_name)
        if own is None:
            try:
                return ros_services.resolve(type_name, "", encoding).text.definition
            except ConfigError:
                return None
        return own.rstrip("\n") + "\n" + self._below(type_name, _halves(type_name, own), encoding)

    def _read(self, name: str) -> str | None:
        if self._files is None:
            self._files = {}
            for root in self._paths:
                for kind in ("msg", "srv"):
                    for file in sorted(root.rglob(f"{kind}/*.{kind}")):
                        self._files.setdefault(f"{file.parent.parent.name}/{kind}/{file.stem}", file)
        path = self._files.get(name)
        if path is None:
            return None
        try:
            return path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: cannot be read ({ros_types.one_line(error)})") from None

    def _below(self, name: str, texts: list[str], encoding: Encoding) -> str:
        """Every type that the texts use, each once, as sections of a definition."""
        sections: dict[str, str] = {}
        for text in texts:
            self._collect(name, text, sections, encoding)
        return "".join(
            f"{_SEPARATOR}MSG: {ros_types.ros1_name(used)}\n" + text.rstrip("\n") + "\n"
            for used, text in sections.items()
        )

    def _collect(self, name: str, text: str, sections: dict[str, str], encoding: Encoding) -> None:
        package, _, base = name.split("/")
        parsed_as = f"{package}/msg/{base}"
        try:
            types = get_types_from_msg(text, parsed_as)
        except TypesysError as error:
            raise ConfigError(f"type {name}: its definition cannot be parsed: {ros_types.one_line(error)}") from None
        for used in ros_types.uses(types[parsed_as][1]):
            if used in sections or used == name:
                continue
            own = self._read(used)
            if own is not None:
                sections[used] = own
                self._collect(used, own, sections, encoding)
                continue
            known = ros_types.describe(used, encoding)
            if known is None:
                raise ConfigError(f"type {name} uses {used}, whose definition is in none of the type_paths")
            sections[used], *rest = known.definition.split(_SEPARATOR)
            for part in rest:
                head, _, body = part.partition("\n")
                sections.setdefault(ros_types.canonical(head.removeprefix("MSG: ").strip()), body)


def _halves(name: str, text: str) -> list[str]:
    """Request and response of a .srv text."""
    halves: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.strip() == _DIVIDER:
            halves.append([])
        else:
            halves[-1].append(line)
    if len(halves) != 2:
        raise ConfigError(f"service type {name}: its definition needs one line of --- between request and response")
    return ["\n".join(half) + "\n" for half in halves]
