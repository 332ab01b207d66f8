"""What is in force of a client's file while it runs: the file as it was read last, and what was set by hand on top.

What was set by hand is of one topic each, or the profile of the adaptation. It outlives a reload, except for a key of
which the file itself says something else than it did before; it ends with the process.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sern_core.bodies.lossy import missing
from sern_core.topics.rules import RuleError
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import TopicName
from sern_runtime.config.adaptation import AdaptationSection
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import checked_section
from sern_runtime.config.topics import TopicSection
from sern_runtime.config.yaml import parse_document

SETTABLE: Final = (
    "class",
    "weight",
    "reliability",
    "depth",
    "lifespan_s",
    "deadline_s",
    "max_rate_hz",
    "retention_s",
    "max_queue_bytes",
    "compression",
    "too_large",
)
"""Keys of a topic that can be set while it runs. The others say which topic it is, or need more than a word."""
MAX_SET: Final = 256
"""Topics of which something is set by hand."""
RELOADED: Final = ("topics", "subscribe", "discovery", "adaptation")
"""Sections that a reload has in force; others need a restart."""


@dataclass(frozen=True, slots=True)
class Reloaded:
    """What a reload did: sections that hold from the next start on, and what was set by hand and no more is."""

    restart: tuple[str, ...]
    ended: tuple[str, ...]


class Settings:
    """`use(file)` has a file in force, or raises ConfigError and changes nothing. `known` are the topics of this site,
    by local name."""

    def __init__(
        self, file: ClientFile, use: Callable[[ClientFile], None], known: Callable[[], Mapping[TopicName, TopicInfo]]
    ) -> None:
        self.file = file
        self._started = file
        self._use = use
        self._known = known
        self._by_topic: dict[TopicName, dict[str, Any]] = {}
        self._profile: str | None = None

    @property
    def by_topic(self) -> Mapping[TopicName, Mapping[str, Any]]:
        """What is set by hand, by local name."""
        return self._by_topic

    @property
    def profile(self) -> str | None:
        """The profile that is set by hand; None: the file's."""
        return self._profile

    def to_json(self) -> dict[str, Any]:
        return {"topics": {name: dict(keys) for name, keys in self._by_topic.items()}, "profile": self._profile}

    # --- by hand ----------------------------------------------------------------------------------------------------

    def set(self, name: TopicName, words: Sequence[str]) -> dict[str, Any]:
        """Set keys of a topic (`key=value` each) beside those that are; returns all of it. Raises UsageError, and then
        nothing has changed."""
        info = self._topic(name)
        if name not in self._by_topic and len(self._by_topic) >= MAX_SET:
            raise UsageError(f"{MAX_SET} topics are set by hand, which is the limit; write rules into the file")
        keys = {**self._by_topic.get(name, {}), **dict(map(_key_value, words))}
        self._have({**self._by_topic, name: keys}, self._profile, info)
        return keys

    def reset(self, name: TopicName) -> None:
        """Have the file's rule for a topic again. Raises UsageError if nothing of it is set."""
        if name not in self._by_topic:
            raise UsageError(f"nothing of {name} is set by hand; `sern set` without more lists what is")
        self._have({each: keys for each, keys in self._by_topic.items() if each != name}, self._profile)

    def set_profile(self, profile: str | None) -> None:
        """Have another profile of the adaptation, None: the file's. Raises UsageError."""
        if profile is not None and self.file.adaptation is None:
            raise UsageError("the file has no section adaptation, so there are no profiles; add one and restart")
        self._have(self._by_topic, profile)

    def _topic(self, name: TopicName) -> TopicInfo:
        problem = name_problem(name)
        if problem is not None:
            raise UsageError(f"topic {name[:80]!r} {problem}")
        info = self._known().get(name)
        if info is None:
            raise UsageError(f"{name} is no topic here; `sern topics` lists those there are")
        return info

    # --- the file anew ----------------------------------------------------------------------------------------------

    def reload(self, file: ClientFile) -> Reloaded:
        """Have a file that was read anew in force. Raises ConfigError, and then nothing has changed."""
        kept: dict[TopicName, dict[str, Any]] = {}
        ended: list[str] = []
        for name, keys in self._by_topic.items():
            before, now = _section_of(self.file, name), _section_of(file, name)
            left = {key: value for key, value in keys.items() if _says(before, key) == _says(now, key)}
            ended += [f"{name} {key}" for key in keys if key not in left]
            if left:
                kept[name] = left
        profile = self._profile
        if profile is not None and file.adaptation != self.file.adaptation:
            profile, ended = None, [*ended, "profile"]
        fields = type(file).model_fields
        different = [key for key in fields if getattr(file, key) != getattr(self._started, key)]
        restart = [key for key in different if key not in RELOADED]
        if (file.adaptation is None) != (self._started.adaptation is None):
            restart.append("adaptation")
        restart += [key for key in ("e_stop", "holder") if _said(file, key) != _said(self._started, key)]
        self._have(kept, profile, file=file)
        return Reloaded(tuple(restart), tuple(ended))

    def _have(
        self,
        by_topic: dict[TopicName, dict[str, Any]],
        profile: str | None,
        info: TopicInfo | None = None,
        *,
        file: ClientFile | None = None,
    ) -> None:
        """Have all this in force, or raise and leave everything as it was."""
        file = file or self.file
        self._use(self._together(file, by_topic, profile, info))
        self.file, self._by_topic, self._profile = file, by_topic, profile

    def _together(
        self,
        file: ClientFile,
        by_topic: Mapping[TopicName, Mapping[str, Any]],
        profile: str | None,
        info: TopicInfo | None,
    ) -> ClientFile:
        """The file with what is set by hand in it."""
        sections = list(file.topics)
        for name, keys in by_topic.items():
            known = info if info is not None and info.name == name else self._known().get(name)
            at = _place(sections, name, "" if known is None else known.type_name)
            base = None if at is None else sections[at]
            section = _changed(base, name, keys)
            if at is None:
                sections.append(section)
            elif base is not None and base.match == name:
                sections[at] = section
            else:
                sections.insert(at, section)
        update: dict[str, Any] = {"topics": tuple(sections)}
        if profile is not None and file.adaptation is not None:
            said = file.adaptation.model_dump(mode="json", exclude_unset=True, exclude={"weights", "floors"})
            try:
                update["adaptation"] = checked_section({**said, "profile": profile}, AdaptationSection)
            except ConfigError as error:
                raise UsageError(f"profile: {error.problem}") from None
        together = file.model_copy(update=update)
        try:
            together.rules()
        except RuleError as error:
            raise UsageError(error.problem) from None
        for section in together.topics:
            for problem in filter(None, map(missing, section.lossy)):
                raise ConfigError(problem)
        return together


def _key_value(word: str) -> tuple[str, Any]:
    key, given, text = word.partition("=")
    if not given:
        raise UsageError(f"{word[:80]!r} is not key=value, such as max_rate_hz=2")
    if key not in SETTABLE:
        raise UsageError(f"{key[:40]!r} cannot be set while it runs; accepted: {', '.join(SETTABLE)}")
    try:
        return key, parse_document(f"value: {text}\n".encode(), file="").data["value"]  # type: ignore[index, call-overload]
    except ConfigError:
        raise UsageError(f"{word[:80]!r}: the value is no number and no word") from None


def _place(sections: Sequence[TopicSection], name: TopicName, type_name: str) -> int | None:
    """Which section is the topic's; None: none is."""
    for index, section in enumerate(sections):
        if section.rule().accepts(name, type_name):
            return index
    return None


def _section_of(file: ClientFile, name: TopicName) -> TopicSection | None:
    """The section of a topic, as far as its name tells."""
    return next((section for section in file.topics if section.rule().match.fullmatch(name)), None)


def _said(file: ClientFile, key: str) -> dict[str, object]:
    """What its rules say of a key that is read at the start alone, where messages come in."""
    receives = [section for section in file.topics if section.direction.receives or key == "e_stop"]
    return {section.match: getattr(section, key) for section in receives if getattr(section, key) is not None}


def _says(section: TopicSection | None, key: str) -> object:
    field = "priority" if key == "class" else key
    return None if section is None or field not in section.model_fields_set else getattr(section, field)


def _changed(base: TopicSection | None, name: TopicName, keys: Mapping[str, Any]) -> TopicSection:
    """A rule for this topic alone. Raises UsageError for a value that is none."""
    said = {} if base is None else base.model_dump(mode="json", by_alias=True, exclude_unset=True)
    try:
        return checked_section({**said, **keys, "match": name}, TopicSection)
    except ConfigError as error:
        raise UsageError(f"{name}: {error.key}: {error.problem}") from None
