"""Definitions from .msg, .srv and .action files, for types that not every installation has.

ROS 2 middleware announces a topic with the name and hash of its type, never with the definition. What is not known here
comes from directories a person names: a ROS install's `share`, a workspace's `src`, or a folder laid out alike
(`PACKAGE/msg/Name.msg`, at any depth).

Of an action `pkg/action/Name` ROS 2 makes messages (`Name_Goal`, `Name_Result`, `Name_Feedback`,
`Name_FeedbackMessage`) and services (`Name_SendGoal`, `Name_GetResult`), all of the kind `action`.
"""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_installation, ros_services, ros_text, ros_types

_SEPARATOR: Final = "=" * 80 + "\n"
_DIVIDER: Final = "---"
_KINDS: Final = ("msg", "srv", "action")
_ACTION_PART: Final = re.compile(r"(?P<action>\w+/action/\w+)_(?P<part>[A-Za-z]+)", re.ASCII)
_ACTION_PARTS: Final = ("Goal", "Result", "Feedback")
_BARE_TYPE: Final = re.compile(r"^\s*([A-Z]\w*)(?![\w/])", re.MULTILINE)
_UUID: Final = "unique_identifier_msgs/UUID goal_id\n"
_MADE: Final = {
    "FeedbackMessage": _UUID + "{action}_Feedback feedback\n",
    "SendGoal": _UUID + "{action}_Goal goal\n---\nbool accepted\nbuiltin_interfaces/Time stamp\n",
    "GetResult": _UUID + "---\nint8 status\n{action}_Result result\n",
}
_KNOWN_ACTIONS: Final = {
    "nav2_msgs/action/NavigateToPose": (
        "geometry_msgs/PoseStamped pose\nstring behavior_tree\n---\nuint16 error_code\nstring error_msg\n---\n"
        "geometry_msgs/PoseStamped current_pose\nbuiltin_interfaces/Duration navigation_time\n"
        "builtin_interfaces/Duration estimated_time_remaining\nint16 number_of_recoveries\nfloat32 distance_remaining\n"
    ),
    "example_interfaces/action/Fibonacci": "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n",
}


class TypeFiles:
    """Definition texts by type name. The directories are searched once, when the first type is asked for.

    `share`: where an installation has the files of a package (`msg/`, `srv/`, `action/` in it), for what they lack."""

    def __init__(self, paths: Iterable[Path] = (), share: Callable[[str], Path | None] | None = None) -> None:
        self._paths = tuple(paths)
        self._share = share
        self._files: dict[str, Path] | None = None

    def message(self, type_name: str, encoding: Encoding = Encoding.CDR) -> str | None:
        """The concatenated definition of a message type, from files or as it is known here; None where it is unknown.

        ConfigError when a file cannot be read, or uses a type that is nowhere.
        """
        name = ros_types.canonical(type_name)
        own = self._own(name)
        if own is None:
            known = ros_types.describe(name, encoding)
            return None if known is None else known.definition
        return own.rstrip("\n") + "\n" + self._below(name, [own], encoding)

    def service(self, type_name: str, encoding: Encoding = Encoding.CDR) -> str | None:
        """The definition of a service type (request, `---`, response, the types they use); None where it is unknown.

        Raises as `message` does.
        """
        own = self._own(type_name)
        if own is None:
            try:
                return ros_services.resolve(type_name, "", encoding).text.definition
            except ConfigError:
                return None
        return own.rstrip("\n") + "\n" + self._below(type_name, _split(type_name, own, 2), encoding)

    def _own(self, name: str) -> str | None:
        """The text of one type, as its file has it or as ROS 2 makes it of an action's."""
        part = _ACTION_PART.fullmatch(name)
        if part is None:
            return self._read(name)
        text = self._read(part["action"]) or _KNOWN_ACTIONS.get(part["action"])
        if text is None:
            return None
        if part["part"] in _MADE:
            return _MADE[part["part"]].format(action=part["action"])
        if part["part"] not in _ACTION_PARTS:
            return None
        own = _split(part["action"], text, len(_ACTION_PARTS))[_ACTION_PARTS.index(part["part"])]
        # A name alone is of the package's messages, also in a text of the kind `action`.
        return _BARE_TYPE.sub(rf"{name.partition('/')[0]}/\1", own)

    def _read(self, name: str) -> str | None:
        if self._files is None:
            self._files = {}
            for root in self._paths:
                for kind in _KINDS:
                    for file in sorted(root.rglob(f"{kind}/*.{kind}")):
                        self._files.setdefault(f"{file.parent.parent.name}/{kind}/{file.stem}", file)
        path = self._files.get(name) or self._shared(name)
        if path is None:
            return None
        try:
            return path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: cannot be read ({ros_types.one_line(error)})") from None

    def _shared(self, name: str) -> Path | None:
        parts = name.split("/")
        if self._share is None or len(parts) != 3 or not all(part.isidentifier() for part in parts):
            return None
        package, kind, base = parts
        share = self._share(package)
        path = None if share is None else share / kind / f"{base}.{kind}"
        return path if path is not None and path.is_file() else None

    def _below(self, name: str, texts: list[str], encoding: Encoding) -> str:
        """Every type that the texts use, each once, as sections of a definition."""
        sections: dict[str, str] = {}
        for text in texts:
            self._collect(name, text, sections, encoding)
        return "".join(
            f"{_SEPARATOR}MSG: {_heading(used)}\n" + text.rstrip("\n") + "\n" for used, text in sections.items()
        )

    def _collect(self, name: str, text: str, sections: dict[str, str], encoding: Encoding) -> None:
        package, _, base = name.split("/")
        parsed_as = f"{package}/msg/{base}"
        types = ros_text.parse(parsed_as, text)
        for used in ros_types.uses(types[parsed_as][1]):
            if used in sections or used == name:
                continue
            own = self._own(used)
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


def installed_files(own: Iterable[Path]) -> list[TypeFiles]:
    """Definitions by where they may come from, the nearest first: the directories `own` with what is sourced, with each
    installation of ROS 2 on this machine, and with what is known here."""
    own = tuple(own)
    groups = ros_installation.overlays()
    return [*(TypeFiles(own, ros_installation.share_in(*group)) for group in groups), TypeFiles(own)]


def _heading(name: str) -> str:
    """The name that a section of a definition gives its type."""
    return name if "/action/" in name else ros_types.ros1_name(name)


def _split(type_name: str, text: str, count: int) -> list[str]:
    """The parts of a .srv or .action text. ConfigError when there are not so many."""
    parts: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.strip() == _DIVIDER:
            parts.append([])
        else:
            parts[-1].append(line)
    if len(parts) != count:
        wanted = "one line of --- between request and response" if count == 2 else "two lines of --- between its parts"
        raise ConfigError(f"type {type_name}: its definition needs {wanted}")
    return ["\n".join(part) + "\n" for part in parts]
