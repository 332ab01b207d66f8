"""The paper's two policy tables on a real link: a Husky's recording and LiDAR scans over `tc netem` in the lab.

Robot, relay and site are the daemons as their user runs them, robot on one side of the link, relay and site on the
other; the robot alone adapts. Nothing of what is reported comes from the controller: messages are counted and timed
by the logs that robot and site write, bytes by netem, processor time of the robot by the kernel. Only what the robot
left out is its own count, so that a class of which nothing was sent is not taken for a lost one. Without the recordings
beside the checkout their topics are made up (`benchmarks.recordings`), and a note says so. Needs root.
"""

import argparse
import asyncio
import json
import sys
import tempfile
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

from benchmarks import recordings
from benchmarks.common import Report, main, positive, try_realtime
from benchmarks.link.runs import DRAIN_S, START_S, STOP_S, sleep_until, start_daemon, start_relay
from benchmarks.link.sern import RELAY_PORT
from benchmarks.mmcf_replay import CLOUD_HZ, EVERY_NTH_POINT, PROFILES, recorded, tabulate
from sern_core.adaptation.adapter import AdapterParams
from sern_core.adaptation.cost import measure as measure_cost
from sern_core.adaptation.model import ClassDemand, ClassOutcome, Terms
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.message import TopicSpec
from sern_core.vocabulary.types import CLASS_LABELS, CLASSES, DropReason
from sern_runtime.config.adaptation import AdaptationSection
from sern_sim.models import LinkModel
from sern_tools.api import get_json
from sern_tools.harness.files import client_content, write
from sern_tools.harness.processes import Children, killed
from sern_tools.keygen import make_keys
from sern_tools.lab.lab import Lab, Node
from sern_tools.message_log import TopicLog, read_logs

ROBOT, SITE = "robot", "site"
HTTP_PORT: Final = 8080
API: Final = f"http://127.0.0.1:{HTTP_PORT}"
LINK: Final = LinkModel(rate_bps=4e6, delay_s=0.025, loss=0.01)
THIN_BPS: Final = 1e6
"""The rate in the second third of a run."""
RUN_S, QUICK_S = 30, 9
WARM_S: Final = 3.0
"""Not counted: the load begins, and a controller finds out what the link carries."""


class Edge(NamedTuple):
    """What had come together by the end of an interval. `left_out`: messages that the adaptation did not let in."""

    wall_ns: int
    wire_bytes: int
    cpu_s: float
    left_out: Mapping[str, int]


def intervals(
    logs: Mapping[str, TopicLog], edges: Sequence[Edge], params: AdapterParams, capacities_bps: Sequence[float]
) -> list[Terms]:
    """The terms of the cost, one for each interval between two `edges`, by what the far end saw.

    `capacities_bps` are what the link was set to carry in each of them, the same for every policy.
    A message belongs to the interval in which it was offered, and is on time by its topic's deadline; what never came
    is not. Raises SernError when the logs hold no message of the time.
    """
    starts_ns = [edge.wall_ns for edge in edges[:-1]]
    count = len(starts_ns)
    offered, delivered, on_time = ([Counter[str]() for _ in range(count)] for _ in range(3))
    nbytes: Counter[str] = Counter()
    latency_s = [dict.fromkeys(CLASS_LABELS, 0.0) for _ in range(count)]
    deadlines_s = dict(zip(CLASS_LABELS, params.deadlines_s, strict=True))
    for log in logs.values():
        arrived = {delivery.seq: delivery for delivery in reversed(log.deliveries)}
        for offer in log.offers.values():
            if not edges[0].wall_ns <= offer.wall_ns < edges[-1].wall_ns:
                continue
            at = bisect_right(starts_ns, offer.wall_ns) - 1
            offered[at][log.priority] += 1
            nbytes[log.priority] += offer.size_bytes
            delivery = arrived.get(offer.seq)
            if delivery is not None:
                delivered[at][log.priority] += 1
                latency_s[at][log.priority] += delivery.latency_s
                on_time[at][log.priority] += delivery.latency_s <= deadlines_s[log.priority]
    totals = sum(offered, Counter[str]())
    if not totals:
        raise SernError("nothing was offered during the run; look at the daemons' logs (--traces)")
    seconds = (edges[-1].wall_ns - edges[0].wall_ns) / 1e9
    labels = list(zip(CLASSES, CLASS_LABELS, strict=True))
    demands = [
        ClassDemand(
            priority,
            totals[label] / seconds,
            nbytes[label] / totals[label],
            deadlines_s[label],
            needed=params.needed[priority],
        )
        for priority, label in labels
        if totals[label]
    ]
    found: list[Terms] = []
    before = None
    for at, (begin, end) in enumerate(pairwise(edges)):
        left_out: Counter[str] = Counter()
        for topic, log in logs.items():
            left_out[log.priority] += end.left_out.get(topic, 0) - begin.left_out.get(topic, 0)
        before = measure_cost(
            demands,
            [
                ClassOutcome(
                    priority,
                    offered[at][label],
                    max(0, offered[at][label] - left_out[label]),
                    on_time[at][label],
                    delivered[at][label],
                    latency_s[at][label],
                    # Classes share datagrams: all bytes are counted under the first.
                    wire_bytes=float(end.wire_bytes - begin.wire_bytes) if label == CLASS_LABELS[0] else 0.0,
                )
                for priority, label in labels
            ],
            interval_s=(end.wall_ns - begin.wall_ns) / 1e9,
            cpu_s=end.cpu_s - begin.cpu_s,
            saturated=False,
            ranges=params.ranges,
            previous=before,
        )
        found.append(
            params.ranges.terms(
                latency_s=before.latency_s,
                unreliability=before.unreliability,
                compute=before.compute,
                bandwidth_bps=before.bandwidth_bps,
                capacity_bps=capacities_bps[at],
            )
        )
    return found


def client_file(
    directory: Path, name: str, address: str, endpoint: Sequence[Mapping[str, Any]], **sections: Any
) -> Path:
    """A client's configuration; `address` is the relay's."""
    sections = {"http": {"listen": None}, **sections}
    content = client_content(
        name,
        f"tcp://{address}:{RELAY_PORT}",
        list(endpoint),
        message_log=f"{name}.csv",
        log={"level": "warning"},
        **sections,
    )
    return write(directory, name, content)


class Played(NamedTuple):
    """The files that a robot plays."""

    drive: Path
    scans: Sequence[Path]


def staged(directory: Path, data: Path = recordings.DATA) -> Played:
    """The drive, and the scans thinned to EVERY_NTH_POINT, in `directory`; made up what `data` does not have."""
    scans = [directory / name for name in recordings.SCANS]
    for points, path in zip(recordings.scans(data), scans, strict=True):
        recordings.write_scan(points[::EVERY_NTH_POINT], path)
    return Played(recordings.drive_file(directory, data), scans)


def robot_file(
    directory: Path, address: str, specs: Mapping[str, TopicSpec], section: AdaptationSection, played: Played
) -> Path:
    """The robot: the recording from its beginning and, beside it, the scans; its topics by `specs`."""
    rules = [
        {
            "match": name,
            "class": CLASS_LABELS[spec.priority],
            "direction": "send",
            "reliability": "best_effort",
            "weight": spec.weight,
            "lifespan_s": spec.lifespan_s,
        }
        for name, spec in specs.items()
    ]
    bag = {"kind": "bag", "path": str(played.drive), "loop": True}
    clouds = {
        "kind": "synthetic",
        "role": "robot",
        "topics": ["/points"],
        "cloud_rate_hz": CLOUD_HZ,
        "cloud_files": [str(path) for path in played.scans],
    }
    return client_file(
        directory,
        ROBOT,
        address,
        [bag, clouds],
        topics=rules,
        adaptation=section.model_dump(mode="json", exclude_unset=True),
        http={"listen": f"127.0.0.1:{HTTP_PORT}"},
    )


def site_file(directory: Path, address: str) -> Path:
    """The site: records all that the robot sends."""
    record = {"kind": "record", "path": str(directory / "site"), "overwrite": True}
    return client_file(directory, SITE, address, [record], client={"namespace": "/"}, subscribe=[f"/{ROBOT}/.*"])


# --- in the lab -------------------------------------------------------------------------------------------------------


def _ask(node: Node, path: str) -> Any:
    return node.inside(lambda: get_json(API, path))


async def _connected(robot: Node, topics: int) -> bool:
    """Whether the robot is connected over the datagram lane, and all of the topics have reached somebody."""
    try:
        link = _ask(robot, "/api/link")
        sent = [entry for entry in _ask(robot, "/api/topics").values() if entry["direction"] == "send"]
    except SernError:
        return False  # it does not listen yet
    parts = link if isinstance(link, list) else [link]
    lanes = [part["lane"] for part in parts]
    return lanes == ["udp"] and sum(entry["delivered"] > 0 for entry in sent) == topics


def _edge(lab: Lab, children: Children) -> Edge:
    topics = _ask(lab.a, "/api/topics")
    left_out = {
        name: int(entry["dropped"].get(DropReason.RATE_CAP, 0))
        for name, entry in topics.items()
        if entry["direction"] == "send"
    }
    return Edge(time.time_ns(), lab.traffic()[0].bytes, children.cpu_s()[ROBOT], left_out)


def rates_bps(duration_s: int) -> list[float]:
    """What the link is set to carry, second by second: thin in the second third."""
    assert LINK.rate_bps is not None
    thin = range(duration_s // 3, 2 * duration_s // 3)
    return [THIN_BPS if second in thin else LINK.rate_bps for second in range(duration_s)]


def run(lab: Lab, directory: Path, section: AdaptationSection, played: Played, duration_s: int) -> list[Terms]:
    """One run over a link that is thin in its second third; intervals of 1 s. `directory` must be empty."""
    make_keys(directory, "relay", ROBOT, SITE)
    load = recorded(1.0)
    specs = {name: spec for name, (_, spec) in load.specs.items()}
    robot = robot_file(directory, lab.b.address, specs, section, played)
    site = site_file(directory, lab.b.address)
    capacities_bps = rates_bps(duration_s)
    edges = asyncio.run(_play(lab, directory, robot, site, len(specs), capacities_bps))
    params = section.params(encodes=True)
    logs = read_logs([(role, directory / f"{role}.csv") for role in (ROBOT, SITE)])
    return intervals(logs, edges, params, capacities_bps)


async def _play(
    lab: Lab, directory: Path, robot: Path, site: Path, topics: int, capacities_bps: Sequence[float]
) -> list[Edge]:
    lab.reset()
    lab.link(LINK, LINK)
    async with killed(directory) as children:
        relay = await start_relay(children, lab.b, udp=True)
        site_daemon = await start_daemon(children, lab.b, "client", site)
        robot_daemon = await start_daemon(children, lab.a, "client", robot)
        problem = "not every topic of the robot got through"
        await children.until(partial(_connected, lab.a, topics), START_S, problem)
        start_ns = time.monotonic_ns() + int(WARM_S * 1e9)
        edges: list[Edge] = []
        for second in range(len(capacities_bps) + 1):
            await sleep_until(start_ns + second * 1_000_000_000)
            children.check()
            edges.append(_edge(lab, children))
            if 0 < second < len(capacities_bps) and capacities_bps[second] != capacities_bps[second - 1]:
                lab.change(rate_bps=capacities_bps[second])
        (directory / "mmcf.json").write_text(json.dumps(_ask(lab.a, "/api/mmcf")))
        await sleep_until(time.monotonic_ns() + int(DRAIN_S * 1e9))
        # The robot first, so that nothing is offered any more; then who listens, then the relay.
        for daemon in (robot_daemon, site_daemon, relay):
            await children.end(daemon, within_s=STOP_S)
    return edges


def _runner(lab: Lab, directory: Path, duration_s: int) -> Callable[[AdaptationSection, int], list[Terms]]:
    played = staged(directory)

    def intervals_of(section: AdaptationSection, number: int) -> list[Terms]:
        mine = directory / f"{section.profile}-{section.policy}-{number}"
        mine.mkdir()
        return run(lab, mine, section, played, duration_s)

    return intervals_of


def measure(options: argparse.Namespace, report: Report) -> None:
    note = try_realtime()  # all that is started inherits the priority
    duration_s = options.seconds or (QUICK_S if options.quick else RUN_S)
    with tempfile.TemporaryDirectory(prefix="sern-mmcf-") as temporary, Lab() as lab:
        directory = Path(temporary)
        if options.traces is not None:
            options.traces.mkdir(parents=True, exist_ok=True)
            directory = Path(tempfile.mkdtemp(prefix="run-", dir=options.traces)).resolve()
        tabulate(report, _runner(lab, directory, duration_s), options.runs, options.profiles)
        report.note(
            f"{recordings.note()}; lab: {lab.backend}; {note}; {duration_s} s a run, means over intervals of 1 s"
        )


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--runs", type=positive, default=1, metavar="N", help="of each policy, in mixed order")
    parser.add_argument("--seconds", type=positive, metavar="N", help=f"of a run, in place of {RUN_S}")
    parser.add_argument("--profiles", nargs="+", choices=PROFILES, default=PROFILES, help="these alone")
    parser.add_argument("--traces", type=Path, metavar="DIR", help="keep logs and /api/mmcf in a new folder there")


if __name__ == "__main__":
    about = __doc__.splitlines()[0] if __doc__ else None
    sys.exit(main("mmcf_lab", measure, description=about, arguments=_arguments))
