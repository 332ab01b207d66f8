"""Makes parts of a client as its file says; each is None where the file says nothing of it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from sern_client.bridge import Bridge
from sern_client.durable import DurableTopics
from sern_client.e_stop import RELEASE_SUFFIX, EStops
from sern_client.endpoints.base import Endpoint
from sern_client.endpoints.composite import with_services
from sern_client.factory import e_stops_of
from sern_client.services import ServiceBridge
from sern_client.site import Site
from sern_client.spool.spool import Spool
from sern_core.site.client import ClientCore
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import Encoding, TopicName
from sern_runtime import clock
from sern_runtime.config.client import ClientFile, ServicesSection
from sern_runtime.config.load import Loaded
from sern_runtime.durable.disk import Disk
from sern_runtime.entry import blamed_on
from sern_runtime.events import EventLog

Made = Loaded[ClientFile]


def durable_maker(loaded: Made) -> Callable[[ClientCore], DurableTopics] | None:
    """What makes the keeper of durable topics."""
    section = loaded.model.durable
    if section is None:
        return None
    disk = Disk.within(loaded.resolve(section.directory), max_bytes=section.max_bytes)
    return lambda core: DurableTopics(disk, core=core, now=clock.now)


def spool_maker(loaded: Made, site: Site) -> Callable[[ClientCore], Spool] | None:
    """What makes the spool."""
    section = loaded.model.spool
    if section is None:
        return None
    directory = loaded.resolve(section.directory)
    return lambda core: Spool(core, site, section, directory)


def services_maker(
    loaded: Made, endpoint: Endpoint, kick: Callable[[], None]
) -> Callable[[ClientCore], ServiceBridge] | None:
    """What makes the bridge of services. Raises ConfigError for rules that no endpoint is for."""
    model = loaded.model
    offer, use = model.offered_services(), model.used_services()
    if not offer and not use:
        return None
    known = with_services(endpoint)
    if known is not None:
        return partial(ServiceBridge, endpoint=known, offer=offer, use=use, namespace=model.namespace, kick=kick)
    if model.services == ServicesSection():
        return None  # actions of ROS 1 are topics
    with blamed_on(loaded.path, "services"):
        kinds = " and ".join(dict.fromkeys(section.kind for section in model.endpoints))
        raise ConfigError(f"an endpoint of kind {kinds} has no services; leave the section out")


def make_e_stops(loaded: Made, bridge: Bridge, events: EventLog) -> EStops:
    """The e-stops of the file, of which there may be none. They are told of messages, and listen for their release."""
    stops, path = e_stops_of(loaded)
    made = EStops(stops, path, events, halt=bridge.inbound.commands.halt)
    if stops:
        bridge.inbound.e_stops = bridge.outbound.e_stops = bridge.inbound.commands.e_stops = made
    for stop in stops:
        release = partial(made.release, stop.topic)
        name = TopicName(f"{_global_name(bridge.site, stop.topic)}{RELEASE_SUFFIX}")
        bridge.asking.listen(name, lambda who, _text, do=release: do(who=who))  # type: ignore[misc]
    return made


def keep_holders(loaded: Made, bridge: Bridge) -> None:
    """Have one operator at a time command each topic of this robot whose rule says so."""
    for section in loaded.model.topics:
        if section.holder is not None and section.direction.receives:
            local = TopicName(section.match)
            bridge.holding.keep(local, _global_name(bridge.site, local), section.holder.lapse_s)


def _global_name(site: Site, local: TopicName) -> TopicName:
    info = TopicInfo(local, "", Encoding.CDR)
    return site.rules.outward(info, local_name=local, namespace=site.namespace)


def rule_of(site: Site, info: TopicInfo) -> TopicSpec:
    """How a topic of this site is treated, by its global name. Raises ConfigError."""
    name = site.rules.inward(info.name, namespace=site.namespace)
    return site.rules.resolve(replace(info, name=name), local_name=name).spec
