"""Reads named link profiles from YAML into the plain data of `sern_sim.profiles`.

The shipped file is `profiles.yaml` beside this module, whose head explains the keys. Every error is a ConfigError of
one line with file, line and key.
"""

import difflib
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime.config.base import FileModel, FileProblem, Section, fault
from sern_runtime.config.load import check_document
from sern_runtime.config.yaml import Document, Node, read_document, shown_key
from sern_sim.models import BurstLoss, Flap, Jitter, LinkModel, RateStep, Window
from sern_sim.profiles import DEFAULT_DURATION_S, LinkProfile

PROFILES_FILE: Final = "profiles.yaml"
"""The shipped profiles, a file of this package."""

_NAME: Final = r"[a-z0-9][a-z0-9-]{0,40}"
_SCRIPT_FIELDS: Final = frozenset({"rate_steps", "blackouts", "flap"})


class BurstLossSection(Section):
    """Gilbert-Elliott loss, probabilities per packet, in netem's terms p, r, 1-h and 1-k."""

    enter: float
    """Probability of the step from the good state to the bad one."""
    leave: float
    """Probability of the step back; 1 / leave is the mean length of a burst in packets."""
    bad_loss: float = 1.0
    """Loss in the bad state."""
    good_loss: float = 0.0
    """Loss in the good state."""


class LinkSection(Section):
    """One direction of a link. A key that is not given has the default of a perfect wire."""

    rate_bps: float | None = None
    """Bits per second; null or absent: no limit."""
    delay_s: float = 0.0
    """One way."""
    jitter_s: float = 0.0
    """Spread of the delay: the half-width of `uniform`, the standard deviation of `normal`."""
    jitter: Jitter = Jitter.NORMAL
    """Distribution of the delay."""
    loss: float = 0.0
    """Probability that a packet is lost."""
    burst_loss: BurstLossSection | None = None
    """Loss in bursts, in addition to `loss`."""
    rate_after_jitter: bool = False
    """Whether packets that waited for one that jitter held back come as fast as the rate allows, not together."""
    reorder: float = 0.0
    """Probability that a packet is held back, or overtakes those before it where `reorder_delay_s` is 0."""
    reorder_delay_s: float = 0.0
    """How long it is held back."""
    duplicate: float = 0.0
    """Probability that a packet arrives twice."""
    queue_packets: int = LinkModel().queue_packets
    """Packets that the bottleneck holds before it drops."""
    overhead_bytes: int = 0
    """Added to each packet for the rate: 28 is IPv4 and UDP."""


class StepSection(Section):
    """One entry of the script: either a new rate or a blackout."""

    at_s: float
    """When, in seconds from the start."""
    rate_bps: float | None = None
    """The rate from then on; null: no limit."""
    blackout_s: Annotated[float, Field(gt=0)] | None = None
    """How long nothing gets through."""
    direction: Literal["both", "up", "down"] = "both"
    """`up` is client to relay."""

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        if len({"rate_bps", "blackout_s"} & self.model_fields_set) != 1:
            raise fault("give either rate_bps or blackout_s")
        return self


class FlapSection(Section):
    """Up, down, up, down, for ever."""

    up_s: float
    """How long it is up."""
    down_s: float
    """How long it is gone."""
    start_s: float = 0.0
    """When the first period begins; the link is up before."""


class ProfileSection(FileModel):
    """One named profile."""

    description: Annotated[str, Field(min_length=1, max_length=200)]
    """One line for people."""
    link: LinkSection = LinkSection()
    """Both directions."""
    up: LinkSection | None = None
    """Keys in which client to relay differs."""
    down: LinkSection | None = None
    """Keys in which relay to client differs."""
    schedule: tuple[StepSection, ...] = ()
    """What happens when, by rising time."""
    flap: FlapSection | None = None
    """Endless interruptions, instead of blackouts in the schedule."""
    duration_s: float = DEFAULT_DURATION_S
    """How long a run takes in which everything happens and is recovered from."""

    def file_problems(self, base_dir: Path) -> Iterator[FileProblem]:
        del base_dir  # a profile names no files
        return iter(())

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        for side in ("up", "down"):
            try:
                self._model(side)
            except UsageError as error:
                raise fault(str(error), *self._blame(str(error), side)) from error
        try:
            self.build("")
        except UsageError as error:
            raise fault(str(error), "duration_s") from error
        return self

    def build(self, name: str) -> LinkProfile:
        """The plain profile. Raises UsageError when values make no sense."""
        return LinkProfile(
            name=name,
            description=self.description,
            up=self._model("up"),
            down=self._model("down"),
            duration_s=self.duration_s,
        )

    def _model(self, side: str) -> LinkModel:
        given = self._given(side)
        burst = given.get("burst_loss")
        if isinstance(burst, BurstLossSection):
            given["burst_loss"] = BurstLoss(burst.enter, burst.leave, burst.bad_loss, burst.good_loss)
        steps = [step for step in self.schedule if step.direction in ("both", side)]
        rates = tuple(RateStep(s.at_s, s.rate_bps) for s in steps if "rate_bps" in s.model_fields_set)
        gone = tuple(Window(s.at_s, s.at_s + s.blackout_s) for s in steps if s.blackout_s is not None)
        flap = None if self.flap is None else Flap(self.flap.up_s, self.flap.down_s, self.flap.start_s)
        return LinkModel(**given, rate_steps=rates, blackouts=gone, flap=flap)

    def _given(self, side: str) -> dict[str, Any]:
        """The keys of this direction that stand in the file, `link` overridden by `up` or `down`."""
        own: LinkSection | None = self.up if side == "up" else self.down
        return {
            key: getattr(section, key)
            for section in (self.link, own)
            if section is not None
            for key in LinkSection.model_fields
            if key in section.model_fields_set
        }

    def _blame(self, problem: str, side: str) -> tuple[str, ...]:
        """The key that a problem of `LinkModel`, which begins with the name of its field, is about."""
        field = problem.replace(":", " ").replace(".", " ").split()[0]
        if field in _SCRIPT_FIELDS:
            return ("flap",) if field == "flap" else ("schedule",)
        own = self.up if side == "up" else self.down
        return (side if own is not None and field in own.model_fields_set else "link", field)


def find_profiles_file() -> Path:
    """The shipped file, of a checkout or an installation. ConfigError when it is absent."""
    path = Path(str(files("sern_runtime") / PROFILES_FILE))
    if not path.is_file():
        raise ConfigError(f"the shipped link profiles are not at {path}: name a file of your own")
    return path


def load_profiles(file: Path | str | None = None) -> dict[str, LinkProfile]:
    """All profiles of `file` (default: the shipped one) by name, in its order. Raises ConfigError."""
    path = find_profiles_file() if file is None else Path(file)
    document = read_document(path)
    sections = _mapping(document.root)
    for key in sections:
        if key != "profiles":
            raise document.error((key,), "unknown key; accepted: profiles")
    nodes = _mapping(document.at(("profiles",))) if sections else {}
    if not nodes:
        raise document.error(("profiles",), "expected a mapping from names to profiles")
    return {name: _profile(document, path, name, node) for name, node in nodes.items()}


def load_profile(name: str, file: Path | str | None = None) -> LinkProfile:
    """The profile `name` of `file` (default: the shipped one). Raises ConfigError, naming those there are."""
    profiles = load_profiles(file)
    if name not in profiles:
        close = difflib.get_close_matches(name, profiles, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ConfigError(f"no link profile {shown_key(name)}{hint}; there are: {', '.join(profiles)}")
    return profiles[name]


def _mapping(node: Node) -> dict[str, Node]:
    return node.value if isinstance(node.value, dict) else {}


def _profile(document: Document, path: Path, name: str, node: Node) -> LinkProfile:
    if not re.fullmatch(_NAME, name):
        raise document.error(("profiles", name), "a profile's name is lower-case letters, digits and hyphens")
    if not isinstance(node.value, dict):
        raise document.error(("profiles", name), "expected a mapping (key: value)")
    profiles = document.data["profiles"] if isinstance(document.data, dict) else None
    data = profiles[name] if isinstance(profiles, dict) else None
    # Each profile is checked as a file of its own, so that messages can name the keys that it accepts.
    checked = check_document(Document(document.file, node, data), path, ProfileSection, files=False)
    if checked.loaded is None:
        error = checked.errors[0]
        key = ".".join(part for part in ("profiles", name, error.key) if part)
        raise ConfigError(error.problem, file=error.file, line=error.line, key=key)
    return checked.loaded.model.build(name)
