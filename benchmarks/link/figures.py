"""What a run amounts to: latencies, goodput, the time until something is right again."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.link.load import FLOOD_BYTES, Kind, Load, Records
from benchmarks.link.runs import Outcome
from benchmarks.link.sern import SAMPLE_COLUMNS, TOPICS
from sern_core.path.lanes import DATAGRAM_BYTES
from sern_core.vocabulary.errors import SernError
from sern_core.wire import framing
from sern_runtime.seal import ROOM_BYTES, SEAL_BYTES, UDP_PAYLOAD_BYTES
from sern_runtime.udp import OVERHEAD_BYTES

ETHERNET_BYTES: Final = 42
"""Ethernet, IPv4 and UDP headers: what netem's rate counts beside the payload of a datagram."""
FRESH_S: Final = 0.1
"""A pose that is at most so much older than the floor is fresh."""
NEAR: Final = 0.25
"""An estimate is right within this share of the capacity."""
HELD_S: Final = 0.3
"""... and when it has been so for so long."""
NEVER_S: Final = 999.0
ALIKE: Final = 0.1
"""Two runs are compared by CPU when they carried as many datagrams, within this share."""
KIND, NUMBER, STAMP, AT, SIZE = range(5)


def latencies_ms(outcome: Outcome, kind: Kind = Kind.POSE) -> NDArray[np.float64]:
    """Latencies of messages that were due after the warm-up and arrived."""
    rows = _after_warm_up(outcome, outcome.arrived)
    rows = rows[rows[:, KIND] == kind]
    result: NDArray[np.float64] = (rows[:, AT] - rows[:, STAMP]) / 1e6
    return result


def _after_warm_up(outcome: Outcome, rows: Records) -> Records:
    kept: Records = rows[rows[:, STAMP] >= outcome.start_ns + int(outcome.warm_s * 1e9)]
    return kept


def quantile(values: NDArray[np.float64], share: float) -> float:
    """NEVER_S, as milliseconds, when there are none."""
    return float(np.quantile(values, share)) if len(values) else 1000 * NEVER_S


def delivered_share(outcome: Outcome, *, forgive_superseded: bool = False) -> float:
    """Poses that arrived, of those offered; without those that gave way to a newer one at either hop if forgiven."""
    offered = outcome.offered[outcome.offered[:, KIND] == Kind.POSE]
    arrived = outcome.arrived[outcome.arrived[:, KIND] == Kind.POSE]
    whole = len(offered)
    got = len(np.unique(arrived[:, NUMBER]))
    if forgive_superseded:
        whole -= min(superseded(outcome), whole - got)
    return got / whole if whole else 0.0


def superseded(outcome: Outcome) -> int:
    """Poses that gave way to a newer one before they were sent, at the robot or the relay."""
    topic = TOPICS[Kind.POSE]
    found = 0
    for topics in (outcome.robot.get("topics", {}), outcome.relay.get("links", {}).get("site", {})):
        found += int(topics.get(topic, {}).get("dropped", {}).get("superseded", 0))
    return found


def goodput_bps(outcome: Outcome) -> float:
    """Bits a second of whole messages, all kinds, between the warm-up and the end of the load.

    Raises SernError when more came through than the link carries: then something went past it.
    """
    begin_ns = outcome.start_ns + int(outcome.warm_s * 1e9)
    end_ns = outcome.start_ns + int(outcome.duration_s * 1e9)
    rows = outcome.arrived
    rows = rows[(rows[:, AT] >= begin_ns) & (rows[:, AT] < end_ns)]
    result = 8e9 * float(rows[:, SIZE].sum()) / (end_ns - begin_ns)
    rate_bps = outcome.model.rate_bps
    if rate_bps is not None:
        # A message may have begun before the window in which its end is counted.
        room_bps = 8e9 * sum(flow.size_bytes for flow in outcome.load.flows) / (end_ns - begin_ns)
        if result > rate_bps + room_bps:
            raise SernError(f"{outcome.system}: {result / 1e6:.2f} Mbit/s of a link of {rate_bps / 1e6:g} Mbit/s")
    return result


def ceiling_bps(outcome: Outcome) -> float:
    """What a link can carry in datagrams of 1200 bytes: full ones, after what the poses take, less what is lost."""
    model = outcome.model
    assert model.rate_bps is not None
    pose = next(flow for flow in outcome.load.flows if flow.kind is Kind.POSE)
    pose_wire_bytes = (
        pose.size_bytes + framing.HEADER_BYTES + framing.DATA_FIRST_BYTES + OVERHEAD_BYTES + ETHERNET_BYTES
    )
    rest_bps = model.rate_bps - 8 * pose.rate_hz * pose_wire_bytes
    body_bytes = DATAGRAM_BYTES - framing.HEADER_BYTES - framing.DATA_BYTES
    whole_bps = rest_bps * body_bytes / (UDP_PAYLOAD_BYTES + ETHERNET_BYTES) + 8 * pose.rate_hz * pose.size_bytes
    return whole_bps * (1 - model.mean_loss)


def flood_ceiling_bps(outcome: Outcome) -> float:
    """What a link can carry of messages of `FLOOD_BYTES`, one in a datagram."""
    assert outcome.model.rate_bps is not None
    overhead_bytes = framing.HEADER_BYTES + framing.DATA_FIRST_BYTES + OVERHEAD_BYTES + ETHERNET_BYTES
    return outcome.model.rate_bps * FLOOD_BYTES / (FLOOD_BYTES + overhead_bytes)


def link_use(outcome: Outcome) -> float:
    """Bytes that left the link, of those it could have carried."""
    assert outcome.model.rate_bps is not None
    return 8 * outcome.wire_bytes / (outcome.model.rate_bps * outcome.duration_s)


def datagrams_hz(outcome: Outcome) -> float:
    """What left the link from the robot to the relay, a second."""
    return outcome.wire_packets / outcome.duration_s


def bare_load(outcome: Outcome) -> Load:
    """What the bare forwarder is given: as many datagrams a second as a run had on its link, each of their mean
    size."""
    if not outcome.wire_packets:
        raise SernError(f"{outcome.system}: nothing left the link")
    size_bytes = round(outcome.wire_bytes / outcome.wire_packets) - ETHERNET_BYTES - SEAL_BYTES
    return Load(even_hz=datagrams_hz(outcome) / (1 - outcome.model.mean_loss), even_bytes=min(size_bytes, ROOM_BYTES))


def busier_percent(outcome: Outcome) -> float:
    """CPU of the robot or of the relay, whichever takes more, of one core."""
    return max(outcome.cpu_percent["robot"], outcome.cpu_percent["relay"])


def forwarding_us(bare: Outcome) -> float:
    """What a datagram cost the bare forwarder. SernError when nothing was measured."""
    if bare.cpu_percent["relay"] <= 0 or not bare.wire_packets:
        raise SernError("the bare forwarder carried nothing")
    return 1e4 * bare.cpu_percent["relay"] / datagrams_hz(bare)


def times_forwarding(outcome: Outcome, bare: Outcome) -> float:
    """CPU of the busier side, times that of a bare forwarder for as many datagrams a second.

    Raises SernError when the forwarder did not carry as many: then the two cannot be compared.
    """
    ours_hz, bare_hz = datagrams_hz(outcome), datagrams_hz(bare)
    if abs(bare_hz - ours_hz) > ALIKE * ours_hz:
        raise SernError(f"the bare forwarder carried {bare_hz:,.0f} datagrams/s, {outcome.system} {ours_hz:,.0f}")
    bare_percent = 1e-4 * forwarding_us(bare) * ours_hz
    return busier_percent(outcome) / bare_percent


def refusing_to_forwarding(spent_percent: float, junk_hz: float, bare: Outcome) -> float:
    """What a datagram of junk costs, by what a good one costs the bare forwarder. All of them took `spent_percent` of a
    core."""
    return 1e4 * spent_percent / junk_hz / forwarding_us(bare)


def first_fresh_s(outcome: Outcome, step: str, floor_s: float) -> float:
    """Time from the order to restore the link until a fresh pose is there. NEVER_S if none came."""
    asked_ns = outcome.events[step][0]
    rows = outcome.arrived[outcome.arrived[:, KIND] == Kind.POSE]
    fresh = rows[(rows[:, AT] >= asked_ns) & (rows[:, AT] - rows[:, STAMP] <= (floor_s + FRESH_S) * 1e9)]
    return float(fresh[:, AT].min() - asked_ns) / 1e9 if len(fresh) else NEVER_S


def settled_s(outcome: Outcome, step: str, capacity_bps: float, until: str | None) -> float:
    """Time from the order to change the rate until the sender's estimate is near it for HELD_S. NEVER_S if it never
    is."""
    asked_ns = outcome.events[step][0]
    end_ns = outcome.events[until][0] if until else outcome.start_ns + int(outcome.duration_s * 1e9)
    samples = samples_of(outcome)
    samples = samples[(samples[:, 0] >= asked_ns) & (samples[:, 0] < end_ns)]
    near = np.abs(samples[:, SAMPLE_COLUMNS.index("rate_bps")] / capacity_bps - 1) <= NEAR
    since_ns = None
    for (at_ns, *_), right in zip(samples, near, strict=True):
        if not right:
            since_ns = None
            continue
        since_ns = at_ns if since_ns is None else since_ns
        if at_ns - since_ns >= HELD_S * 1e9:
            return float(since_ns - asked_ns) / 1e9
    return NEVER_S


def samples_of(outcome: Outcome) -> NDArray[np.float64]:
    """What the sender's link thought, shape (samples, len(SAMPLE_COLUMNS)); empty for other systems."""
    return np.array(outcome.robot.get("samples", []), dtype=np.float64).reshape(-1, len(SAMPLE_COLUMNS))


def metrics(outcome: Outcome) -> dict[str, float]:
    """The row of a run. Only what is there: no p99 of poses that never came."""
    poses = latencies_ms(outcome)
    found: dict[str, float] = {}
    if len(poses):
        found |= {
            "pose_p50_ms": quantile(poses, 0.50),
            "pose_p99_ms": quantile(poses, 0.99),
        }
    found["poses_percent"] = 100 * delivered_share(outcome)
    if outcome.load.flood_bps:
        floods = latencies_ms(outcome, Kind.FLOOD)
        found |= {"flood_p50_ms": quantile(floods, 0.50), "flood_p99_ms": quantile(floods, 0.99)}
    if outcome.load.cloud_bytes or outcome.load.flood_bps:
        found["goodput_Mbps"] = goodput_bps(outcome) / 1e6
        found["wire_percent"] = 100 * link_use(outcome)
    for role, label in (("robot", "robot_cpu"), ("relay", "relay_cpu"), ("site", "site_cpu")):
        if role in outcome.cpu_percent:
            found[f"{label}_percent"] = outcome.cpu_percent[role]
    return found
