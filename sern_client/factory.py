"""Makes endpoints from the sections of a client file."""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Final

from sern_client.endpoints.bag import BagEndpoint, BagOptions
from sern_client.endpoints.base import Endpoint, Publisher
from sern_client.endpoints.composite import CompositeEndpoint
from sern_client.endpoints.rclpy import RclpyEndpoint, RclpyOptions
from sern_client.endpoints.record import RecordEndpoint, RecordOptions
from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options
from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions
from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
from sern_client.endpoints.zenoh.options import ZenohOptions
from sern_client.endpoints.zenoh.session import SessionOptions
from sern_client.link_topics import LinkTopics
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.types import Encoding
from sern_runtime.config import endpoints as sections
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import Loaded

Resolve = Callable[[str], Path]


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
            return BagEndpoint(
                BagOptions(
                    path=resolve(section.path),
                    rate=section.rate,
                    loop=section.loop,
                    namespaces=section.namespaces,
                    topics=section.topics,
                    deny=section.deny,
                    start_delay_s=section.start_delay_s,
                    wait_for=section.wait_for,
                    on_refused=section.on_refused,
                    stamps=section.stamps,
                )
            )
        case sections.RecordEndpoint():
            return RecordEndpoint(
                RecordOptions(
                    path=resolve(section.path),
                    overwrite=section.overwrite,
                    max_buffer_bytes=section.max_buffer_bytes,
                    flush_s=section.flush_s,
                    sync=section.sync,
                ),
                folder=section.path.endswith("/"),
            )
        case sections.RclpyEndpoint():
            return RclpyEndpoint(
                RclpyOptions(
                    node_name=section.node_name,
                    domain=section.domain,
                    poll_hz=section.poll_hz,
                    type_paths=tuple(resolve(path) for path in section.type_paths),
                )
            )
        case sections.ZenohEndpoint():
            return ZenohEndpoint(
                ZenohOptions(
                    session=SessionOptions(
                        connect=section.connect,
                        listen=section.listen,
                        config_file=None if section.config_file is None else resolve(section.config_file),
                        second=second,
                    ),
                    domain=section.domain,
                    node_name=section.node_name,
                    type_paths=tuple(resolve(path) for path in section.type_paths),
                )
            )
        case sections.DdsEndpoint():
            return _dds(section, resolve)
        case sections.SyntheticEndpoint():
            return SyntheticEndpoint(_synthetic(section, resolve))
        case sections.Ros1Endpoint():
            return Ros1Endpoint(Ros1Options(**{item.name: getattr(section, item.name) for item in fields(Ros1Options)}))
    raise UsageError(f"no endpoint for a section of type {type(section).__name__}")


def _dds(section: sections.DdsEndpoint, resolve: Resolve) -> Endpoint:
    try:
        from sern_client.endpoints.dds.domain import DomainOptions, environment_domain
        from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
    except ImportError as error:
        raise ConfigError(
            f"endpoint kind dds needs Cyclone DDS: {sections.installing('cyclonedds==11.0.1')} ({error})"
        ) from None
    return DdsEndpoint(
        DdsOptions(
            DomainOptions(
                domain=environment_domain() if section.domain is None else section.domain,
                interface=section.interface,
                peers=section.peers,
                multicast=section.multicast,
                localhost_only=section.localhost_only,
                fragment_bytes=section.fragment_bytes,
                receive_buffer_bytes=section.receive_buffer_bytes,
                lease_s=section.lease_s,
            ),
            node_name=section.node_name,
            type_paths=tuple(resolve(path) for path in section.type_paths),
            queue_depth=section.queue_depth,
            max_buffer_bytes=section.max_buffer_bytes,
            offer_lifespan=section.offer_lifespan,
            heed_sern=section.heed_sern,
        )
    )


def _synthetic(section: sections.SyntheticEndpoint, resolve: Resolve) -> SyntheticOptions:
    # Section and options have the same fields on purpose; a test keeps them so.
    names = [item.name for item in fields(SyntheticOptions) if item.name != "cloud_files"]
    values = {name: getattr(section, name) for name in names}
    return SyntheticOptions(cloud_files=tuple(resolve(path) for path in section.cloud_files), **values)
