"""Makes an endpoint from its section of a client file. A kind that no section names is not even imported."""

from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar, get_args, get_type_hints

from sern_client.endpoints.base import Endpoint
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime.config import endpoints as sections
from sern_runtime.config.base import EndpointBase
from sern_runtime.config.foxglove import FoxgloveEndpoint, installing_foxglove
from sern_runtime.config.twin import TwinEndpoint
from sern_runtime.config.unity import UnityEndpoint

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

VIEW_PACKAGES: Final = "'sern[viz]'"
Resolve = Callable[[str], Path]
Options = TypeVar("Options", bound="DataclassInstance")


def make_section(
    section: sections.EndpointSection, resolve: Resolve, *, second: bool = False, as_node: bool = False
) -> Endpoint:
    """One of them. `second`: another process has an endpoint of this section already, whose ports are taken, and which
    reads what there is. `as_node`: it is a node as others have, and clients take what it publishes for their site's."""
    match section:
        case sections.BagEndpoint():
            from sern_client.endpoints.bag import BagEndpoint, BagOptions

            return BagEndpoint(options_of(BagOptions, section, resolve))
        case sections.RecordEndpoint():
            from sern_client.endpoints.record import RecordEndpoint, RecordOptions

            return RecordEndpoint(options_of(RecordOptions, section, resolve), folder=section.path.endswith("/"))
        case sections.RclpyEndpoint():
            from sern_client.endpoints.rclpy import RclpyEndpoint, RclpyOptions

            return RclpyEndpoint(options_of(RclpyOptions, section, resolve, as_node=as_node))
        case sections.ZenohEndpoint():
            from sern_client.endpoints.zenoh.endpoint import ZenohEndpoint
            from sern_client.endpoints.zenoh.options import ZenohOptions

            given = {"second": second} | ({"enclave": "/"} if as_node else {})
            return ZenohEndpoint(options_of(ZenohOptions, section, resolve, **given))
        case sections.DdsEndpoint():
            return _dds(section, resolve, as_node=as_node)
        case TwinEndpoint():
            return _twin(section, resolve)
        case FoxgloveEndpoint():
            return _foxglove(section, resolve)
        case UnityEndpoint():
            return _unity(section, resolve, second=second)
        case sections.SyntheticEndpoint():
            from sern_client.endpoints.synthetic import SyntheticEndpoint, SyntheticOptions

            return SyntheticEndpoint(options_of(SyntheticOptions, section, resolve))
        case sections.Ros1Endpoint():
            from sern_client.endpoints.ros1 import Ros1Endpoint, Ros1Options

            return Ros1Endpoint(options_of(Ros1Options, section, resolve, publishes_only=second, as_node=as_node))
    raise UsageError(f"no endpoint for a section of type {type(section).__name__}")


def options_of(kind: type[Options], section: EndpointBase, resolve: Resolve, **given: object) -> Options:
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


def _twin(section: TwinEndpoint, resolve: Resolve) -> Endpoint:
    from sern_client.endpoints.twin.endpoint import TwinEndpoint
    from sern_client.endpoints.twin.options import Datum, FrameOrigin, RobotOptions, TwinOptions, ViewOptions

    robots = tuple(
        RobotOptions(
            **robot.model_dump(exclude={"origin", "datum", "error_m", "error_mps"}),
            origin=FrameOrigin(**robot.origin.model_dump()),
            datum=None if robot.datum is None else Datum(**robot.datum.model_dump()),
            error_m=robot.errors[0],
            error_mps=robot.errors[1],
        )
        for robot in section.robots
    )
    view = None
    if section.view is not None:
        if not sections.installed("viser"):
            raise ConfigError(f"needs viser: {sections.installing(VIEW_PACKAGES)}", key="endpoint.view")
        view = ViewOptions(*section.view.place)
    options = options_of(TwinOptions, section.model_copy(update={"robots": robots, "view": view}), resolve)
    return TwinEndpoint(options)


def _foxglove(section: FoxgloveEndpoint, resolve: Resolve) -> Endpoint:
    if not sections.installed("foxglove"):
        raise ConfigError(f"endpoint kind foxglove needs foxglove-sdk: {installing_foxglove()}")
    from sern_client.endpoints.foxglove.endpoint import FoxgloveEndpoint
    from sern_client.endpoints.foxglove.options import FoxgloveOptions

    return FoxgloveEndpoint(options_of(FoxgloveOptions, section, resolve))


def _unity(section: UnityEndpoint, resolve: Resolve, *, second: bool) -> Endpoint:
    from sern_client.endpoints.unity.endpoint import UnityEndpoint
    from sern_client.endpoints.unity.options import UnityOptions

    return UnityEndpoint(options_of(UnityOptions, section, resolve, second=second))


def _dds(section: sections.DdsEndpoint, resolve: Resolve, *, as_node: bool) -> Endpoint:
    try:
        from sern_client.endpoints.dds.domain import environment_domain
        from sern_client.endpoints.dds.endpoint import DdsEndpoint, DdsOptions
    except ImportError as error:
        raise ConfigError(
            f"endpoint kind dds needs Cyclone DDS: {sections.installing('cyclonedds==11.0.1')} ({error})"
        ) from None
    if section.domain is None:
        section = section.model_copy(update={"domain": environment_domain()})
    return DdsEndpoint(options_of(DdsOptions, section, resolve, as_node=as_node))
