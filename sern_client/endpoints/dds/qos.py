"""Quality of service: what ROS 2 endpoints offer and ask for, what follows for ours, who does not match whom and why.

History is not in here: DDS does not announce it. What comes from DDS takes `depth` from its rule; what goes to DDS has
the depth of its stream.
"""

from dataclasses import dataclass
from typing import Any, Final

from cyclonedds.core import Policy, Qos

from sern_client.endpoints.dds.names import read_user_data, user_data
from sern_client.endpoints.dds.raw import INFINITE_NS, Announced
from sern_core.vocabulary.message import TopicInfo

_DURABILITY: Final = ("volatile", "transient_local", "transient", "persistent")
_LIVELINESS: Final = ("automatic", "manual_by_participant", "manual_by_topic")


@dataclass(frozen=True, slots=True)
class EndpointQos:
    """The policies of one reader or writer that decide whether it matches another (DDS 1.4, 2.2.3), and its lifespan.

    `durability` and `liveliness` count upwards: an offer must be at least what is asked for.
    """

    reliable: bool = False
    durability: int = 0
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: int = 0
    lease_ns: int = INFINITE_NS
    exclusive: bool = False
    partitions: tuple[str, ...] = ()
    type_hash: str = ""
    service_id: str = ""
    """What rmw_cyclonedds calls a service or client in the USER_DATA of its readers and writers."""

    @property
    def transient_local(self) -> bool:
        return self.durability > 0


def read_qos(announced: Announced) -> EndpointQos:
    """The policies of a discovered endpoint, as far as they matter here."""
    said = read_user_data(announced.user_data)
    return EndpointQos(
        reliable=announced.reliable,
        durability=announced.durability,
        deadline_ns=announced.deadline_ns,
        lifespan_ns=announced.lifespan_ns,
        liveliness=announced.liveliness,
        lease_ns=announced.lease_ns,
        exclusive=announced.exclusive,
        partitions=announced.partitions,
        type_hash=said.get("typehash", ""),
        service_id=said.get("serviceid") or said.get("clientid", ""),
    )


def mismatches(offered: EndpointQos, asked: EndpointQos) -> list[str]:
    """The policies for which a writer and a reader do not match, each as one phrase; empty when they do."""
    found = []
    if asked.reliable and not offered.reliable:
        found.append("reliability (offered best_effort, asked for reliable)")
    if asked.durability > offered.durability:
        found.append(
            f"durability (offered {_DURABILITY[offered.durability]}, asked for {_DURABILITY[asked.durability]})"
        )
    if asked.deadline_ns < offered.deadline_ns:
        found.append(f"deadline (offered {_seconds(offered.deadline_ns)}, asked for {_seconds(asked.deadline_ns)})")
    if asked.liveliness > offered.liveliness:
        found.append(
            f"liveliness (offered {_LIVELINESS[offered.liveliness]}, asked for {_LIVELINESS[asked.liveliness]})"
        )
    if asked.lease_ns < offered.lease_ns:
        found.append(f"liveliness lease (offered {_seconds(offered.lease_ns)}, asked for {_seconds(asked.lease_ns)})")
    if asked.exclusive != offered.exclusive:
        found.append("ownership (one shared, one exclusive)")
    if not _meet(offered.partitions, asked.partitions):
        found.append("partition")
    return found


def _meet(some: tuple[str, ...], others: tuple[str, ...]) -> bool:
    """Whether a writer's and a reader's partitions have one in common. None named is the one without a name."""
    if not some or not others:
        return any(not name.strip("*") for name in (some or others or ("",)))  # "*" stands for each, that one too
    return not set(some).isdisjoint(others)


def within_reach(writers: list[EndpointQos]) -> list[EndpointQos]:
    """Those of a topic's writers that one reader of ours can match all: in the partition without a name, and of shared
    ownership, unless all of these are exclusive. No number of others takes our reader from a shared one."""
    here = [writer for writer in writers if _meet(writer.partitions, ())]
    exclusive = all(writer.exclusive for writer in here)
    return [writer for writer in here if writer.exclusive is exclusive]


def _seconds(duration_ns: int) -> str:
    return "none" if duration_ns >= INFINITE_NS else f"{duration_ns / 1e9:g} s"


def reader_for(writers: list[EndpointQos]) -> EndpointQos:
    """What to ask for so that every one of these writers matches: what the least of them offers."""
    return EndpointQos(
        reliable=bool(writers) and all(writer.reliable for writer in writers),
        durability=min(1, *(writer.durability for writer in writers)) if writers else 0,
        liveliness=0,
        exclusive=bool(writers) and all(writer.exclusive for writer in writers),
    )


def writer_for(info: TopicInfo, *, lifespan: bool) -> EndpointQos:
    """What a stream that comes in is offered with: reliable always, which matches every subscriber. ROS 2 subscribers
    ask for that by default, also of a topic that is best effort on the link."""
    return EndpointQos(
        reliable=True,
        durability=1 if info.latched else 0,
        deadline_ns=INFINITE_NS if info.deadline_s is None else round(info.deadline_s * 1e9),
        lifespan_ns=INFINITE_NS if info.lifespan_s is None or not lifespan else round(info.lifespan_s * 1e9),
        type_hash=info.type_hash,
    )


def to_policies(qos: EndpointQos, *, depth: int, writer: bool, id_key: str = "clientid") -> Qos:
    """The policies in Cyclone DDS's terms. A writer never waits for its readers: the event loop would."""
    policies: list[Any] = [
        Policy.Reliability.Reliable(0 if writer else 100_000_000) if qos.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.transient_local else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.IgnoreLocal.Participant,
    ]
    said = {"typehash": qos.type_hash} if qos.type_hash else {}
    if qos.service_id:
        said[id_key] = qos.service_id
    if said:
        policies.append(Policy.Userdata(user_data(**said)))
    if qos.deadline_ns < INFINITE_NS:
        policies.append(Policy.Deadline(qos.deadline_ns))
    if qos.exclusive:
        policies.append(Policy.Ownership.Exclusive)
    if writer:
        policies.append(Policy.WriterDataLifecycle(autodispose=False))
        if qos.lifespan_ns < INFINITE_NS:
            policies.append(Policy.Lifespan(qos.lifespan_ns))
        if qos.transient_local:
            history = Policy.History.KeepLast(depth)
            policies.append(Policy.DurabilityService(0, history, -1, -1, -1))
    return Qos(*policies)
