"""Makes a client's endpoint, and what publishes the state of its link, from its file."""

import os
from collections.abc import Callable, Sequence
from typing import Final

from sern_client.endpoints.base import Endpoint, Publisher
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.link_topics import LinkTopics
from sern_client.sections import make_section
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime.config import endpoints as sections
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import Loaded


def make_endpoint(loaded: Loaded[ClientFile]) -> Endpoint:
    """The endpoint of a client: the one its file names, or several as one. Raises ConfigError."""
    named = named_sections(loaded.model)
    made = [make_section(section, loaded.resolve) for section in named]
    if len(made) == 1:
        return made[0]
    elsewhere = services_elsewhere(named)
    services_only = [
        endpoint
        for section, endpoint in zip(named, made, strict=True)
        if isinstance(section, sections.RclpyEndpoint) and section.services_only
    ]
    return CompositeEndpoint(made, no_services_of=[made[index] for index in elsewhere], no_topics_of=services_only)


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
