"""Makes endpoints from the sections of a client file."""

from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar, get_args, get_type_hints

from sern_client.endpoints.bag import BagEndpoint, BagOptions
from sern_client.endpoints.base import Endpoint, Publisher
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.rclpy import RclpyEndpoint, RclpyOptions
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.link_topics import LinkTopics
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime.config import endpoints as sections
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import Loaded

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Resolve = Callable[[str], Path]
Options = TypeVar("Options", bound="DataclassInstance")


def make_endpoint(loaded: Loaded[ClientFile]) -> Endpoint:
    """The endpoint of a client: the one its file names, or several as one. Raises ConfigError."""
    made = [make_section(section, loaded.resolve) for section in named_sections(loaded.model)]
    return made[0] if len(made) == 1 else CompositeEndpoint(made)


ROS_SECTIONS: Final = (
    sections.Ros1Endpoint,
    sections.DdsEndpoint,
    sections.ZenohEndpoint,
    sections.RclpyEndpoint,
)


def make_link_topics(model: ClientFile, advertise: Callable[[TopicInfo], Publisher]) -> LinkTopics | None:
    """What publishes the state of the link, in the encoding of the first endpoint that has one; None: nothing is
    published."""
    state = model.link_state
    ros = [section for section in model.endpoints if isinstance(section, ROS_SECTIONS)]
    if not (ros if state.publish is None else state.publish):
        return None
    first = ros[0] if ros else model.endpoints[0]
    cdr = not isinstance(first, sections.Ros1Endpoint)
    if isinstance(first, sections.RecordEndpoint):
        cdr = first.path.endswith(".mcap")
    elif isinstance(first, sections.SyntheticEndpoint):
        cdr = first.encoding == "cdr"
    return LinkTopics(model.name, Encoding.CDR if cdr else Encoding.ROS1, advertise, diagnostics=state.diagnostics)


def named_sections(model: ClientFile) -> list[sections.EndpointSection]:
    """The sections, ROS nodes with the names that they get when the file gives none: no two of them the same, because
    a master lets only the last node of a name live."""
    named: list[sections.EndpointSection] = []
    nodes = 0
    for section in model.endpoints:
        if isinstance(section, sections.Ros1Endpoint):
            nodes += 1
            if section.node_name is None:
                name = f"sern_{model.name}" + (f"_{nodes}" if nodes > 1 else "")
                section = section.model_copy(update={"node_name": name})
        named.append(section)
    return named


def make_section(section: sections.EndpointSection, resolve: Resolve, *, second: bool = False) -> Endpoint:
    """One of them. `second`: another process has an endpoint of this section already, whose ports are taken."""
    match section:
        case sections.BagEndpoint():
            return BagEndpoint(options_of(BagOptions, section, resolve))
        case sections.RecordEndpoint():
            return RecordEndpoint(options_of(RecordOptions, section, resolve), folder=section.path.endswith("/"))
        case sections.RclpyEndpoint():
            return RclpyEndpoint(options_of(RclpyOptions, section, resolve))
        case sections.ZenohEndpoint():
            return ZenohEndpoint(options_of(ZenohOptions, section, resolve, second=second))
        case sections.DdsEndpoint():
            return _dds(section, resolve)
        case sections.SyntheticEndpoint():
            return SyntheticEndpoint(options_of(SyntheticOptions, section, resolve))
        case sections.Ros1Endpoint():
            return Ros1Endpoint(options_of(Ros1Options, section, resolve))
    raise UsageError(f"no endpoint for a section of type {type(section).__name__}")


def options_of(kind: type[Options], section: sections.EndpointBase, resolve: Resolve, **given: object) -> Options:
    """The options of an endpoint: each field is the key of its name in the section, a test holds the two together.

    Paths are those that the file means. Options within options come from the same section. `given`: what no file says.
    """
    values: dict[str, object] = {}
    for name, hint in get_type_hints(kind).items():
        if is_dataclass(hint):
            assert isinstance(hint, type)
            values[name] = options_of(hint, section, resolve, **given)
        elif hasattr(section, name):
            value = getattr(section, name)
            values[name] = _resolved(value, resolve) if Path in (hint, *get_args(hint)) else value
        elif name in given:
            values[name] = given[name]
    return kind(**values)


def _resolved(value: str | Sequence[str] | None, resolve: Resolve) -> Path | tuple[Path, ...] | None:
    if value is None:
        return None
    return resolve(value) if isinstance(value, str) else tuple(resolve(path) for path in value)


def _dds(section: sections.DdsEndpoint, resolve: Resolve) -> Endpoint:
    try:
        from sern_client.endpoints.dds.domain import environment_domain
        from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
    except ImportError as error:
        raise ConfigError(
            f"endpoint kind dds needs Cyclone DDS: {sections.installing('cyclonedds==11.0.1')} ({error})"
        ) from None
    if section.domain is None:
        section = section.model_copy(update={"domain": environment_domain()})
    return DdsEndpoint(options_of(DdsOptions, section, resolve))
