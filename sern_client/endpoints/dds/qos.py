"""Quality of service: what ROS 2 endpoints offer and ask for, what follows for ours, who does not match whom and why.

History is not in here: DDS does not announce it. What comes from DDS takes `depth` from its rule; what goes to DDS has
the depth of its stream.
"""

from dataclasses import dataclass
from typing import Any, Final

from cyclonedds.core import Policy, Qos

from sern_client.endpoints.dds.names import read_user_data, user_data
from sern_core.message import TopicInfo

INFINITE_NS: Final = 2**63 - 1
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


def read_qos(qos: Qos) -> EndpointQos:
    """The policies of a discovered endpoint, as far as they matter here."""
    liveliness = qos[Policy.Liveliness]
    user = qos[Policy.Userdata]
    said = read_user_data(bytes(user.data)) if user is not None else {}
    partition = qos[Policy.Partition]
    return EndpointQos(
        reliable=isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable),
        durability=_rank(qos[Policy.Durability], ("Volatile", "TransientLocal", "Transient", "Persistent")),
        deadline_ns=_ns(qos[Policy.Deadline], "deadline"),
        lifespan_ns=_ns(qos[Policy.Lifespan], "lifespan"),
        liveliness=_rank(liveliness, ("Automatic", "ManualByParticipant", "ManualByTopic")),
        lease_ns=_ns(liveliness, "lease_duration"),
        exclusive=qos[Policy.Ownership] == Policy.Ownership.Exclusive,
        partitions=tuple(partition.partitions) if partition is not None else (),
        type_hash=said.get("typehash", ""),
        service_id=said.get("serviceid") or said.get("clientid", ""),
    )


def _rank(policy: Any, names: tuple[str, ...]) -> int:
    """Where a policy's kind stands among the kinds of its sort; the first for one that was not said."""
    words = type(policy).__qualname__, repr(policy)
    return max((rank for rank, name in enumerate(names) if any(_ends(word, name) for word in words)), default=0)


def _ends(text: str, name: str) -> bool:
    return text.partition("(")[0].rpartition(".")[2] == name


def _ns(policy: Any, field: str) -> int:
    return INFINITE_NS if policy is None else int(getattr(policy, field))


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
    if set(asked.partitions or ("",)).isdisjoint(offered.partitions or ("",)):
        found.append("partition")
    return found


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
    """What a stream that comes in is offered with. A ROS 1 stream does not say how reliable it is: it was all TCP."""
    return EndpointQos(
        reliable=info.reliable is not False or info.latched,
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
