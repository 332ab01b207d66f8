"""Makes a client's endpoint, and what publishes the state of its link, from its file."""

import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from sern_client.actions import ACCEPT_S
from sern_client.e_stop import EStop
from sern_client.endpoints.base import Endpoint, Publisher
from sern_client.endpoints.composite import CompositeEndpoint, with_services
from sern_client.link_topics import LinkTopics
from sern_client.sections import Resolve, make_section
from sern_core.topics.patterns import PatternSet, compile_pattern
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime.config import endpoints as sections
from sern_runtime.config.client import ClientFile
from sern_runtime.config.foxglove import FoxgloveEndpoint
from sern_runtime.config.load import Loaded
from sern_runtime.config.twin import TwinEndpoint
from sern_runtime.config.unity import UnityEndpoint
from sern_runtime.ros_files import installed_files

_log = logging.getLogger(__name__)


def make_endpoint(loaded: Loaded[ClientFile]) -> Endpoint:
    """The endpoint of a client: the one its file names, or several as one. Raises ConfigError."""
    return _with_actions(loaded, combined(named_sections(loaded.model), loaded.resolve))


def combined(named: Sequence[sections.EndpointSection], resolve: Resolve, *, as_node: bool = False) -> Endpoint:
    """The endpoints of some sections as one. `as_node` as in `make_section`. Raises ConfigError."""
    made = [make_section(section, resolve, as_node=as_node) for section in named]
    if len(made) == 1:
        return made[0]
    services_only = [
        endpoint
        for section, endpoint in zip(named, made, strict=True)
        if isinstance(section, sections.RclpyEndpoint) and section.services_only
    ]
    elsewhere = [made[index] for index in services_elsewhere(named)]
    return CompositeEndpoint(made, no_services_of=elsewhere, no_topics_of=services_only)


def _with_actions(loaded: Loaded[ClientFile], endpoint: Endpoint) -> Endpoint:
    """The endpoint with actions of the other ROS, where nodes of one ROS here use actions."""
    model = loaded.model
    ros = [section for section in model.endpoints if isinstance(section, ROS_SECTIONS)]
    encodings = {Encoding.ROS1 if isinstance(section, sections.Ros1Endpoint) else Encoding.CDR for section in ros}
    services = with_services(endpoint)
    if not model.actions.use or not encodings or services is None:
        return endpoint
    if len(encodings) > 1:
        _log.info("with endpoints of ROS 1 and of ROS 2 in one client, no action is converted from one to the other")
        return endpoint
    from sern_client.action_conversion.endpoint import ActionEndpoint, Rule

    rules = [
        Rule(compile_pattern(section.match), section.service_rules()[0].timeout_s + 2 * ACCEPT_S)
        for section in model.actions.use
    ]
    paths = [
        loaded.resolve(path) for section in ros if not isinstance(section, sections.Ros1Endpoint)
        for path in section.type_paths
    ]  # fmt: skip
    return ActionEndpoint(
        endpoint, services, encodings.pop(), rules, namespace=model.namespace, files=installed_files(paths)
    )


def services_elsewhere(named: Sequence[sections.EndpointSection]) -> list[int]:
    """The `dds` endpoints, by index, whose domain's services another section is there for. With both a call would be
    answered twice."""
    served = {
        _domain(section) for section in named if isinstance(section, sections.RclpyEndpoint) and section.services_only
    }
    return [
        index
        for index, section in enumerate(named)
        if isinstance(section, sections.DdsEndpoint) and _domain(section) in served
    ]


def _domain(section: sections.DdsEndpoint | sections.RclpyEndpoint) -> str:
    number = os.environ.get("ROS_DOMAIN_ID") or "0"
    return number if section.domain is None else str(section.domain)


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
    return LinkTopics(model.name, local_encoding(model), advertise, diagnostics=state.diagnostics)


def local_encoding(model: ClientFile) -> Encoding:
    """The encoding of messages that this client makes for its site: that of the first endpoint that has one."""
    ros = [section for section in model.endpoints if isinstance(section, ROS_SECTIONS)]
    first = ros[0] if ros else model.endpoints[0]
    cdr = not isinstance(first, sections.Ros1Endpoint)
    if isinstance(first, sections.RecordEndpoint):
        cdr = first.path.endswith(".mcap")
    elif isinstance(first, sections.SyntheticEndpoint | TwinEndpoint | FoxgloveEndpoint):
        cdr = first.encoding == "cdr"
    elif isinstance(first, UnityEndpoint):
        cdr = first.protocol == "ros2"
    return Encoding.CDR if cdr else Encoding.ROS1


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


def e_stops_of(loaded: Loaded[ClientFile]) -> tuple[list[EStop], Path]:
    """The e-stops of a client's file, and where it is kept that they are latched."""
    model = loaded.model
    sections = [(section, section.e_stop) for section in model.topics if section.e_stop is not None]
    stops = [EStop(TopicName(section.match), PatternSet(said.stops)) for section, said in sections]
    named = next((said.file for _section, said in sections if said.file is not None), None)
    if named is not None:
        return stops, loaded.resolve(named)
    state = os.environ.get("STATE_DIRECTORY", "").split(":")[-1]
    folder = Path(state) if state else loaded.path.parent.resolve()
    return stops, folder / f"{model.name}.e_stop"
