"""The bare forwarder does what a relay must at least, and no more; CPU is told as a multiple of its own."""

import select
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("psutil")

from benchmarks.common import Report
from benchmarks.link import figures
from benchmarks.link.cases import Bench
from benchmarks.link.forwarder import Forwarder, Hops
from benchmarks.link.load import Kind, Load
from benchmarks.link.runs import Outcome
from sern_core.vocabulary.errors import SernError
from sern_runtime.seal import ROOM_BYTES, SEAL_BYTES, Opener, Sealer, Side
from sern_sim.models import LinkModel
from sern_tools.lab.lab import Lab
from tests.benchmarks.test_link import outcome
from tests.support import DEADLINE_S


class Path3:
    """Robot, forwarder and site, each with a socket on loopback."""

    def __init__(self, stack: ExitStack) -> None:
        self.robot, self.inlet, outlet, self.site = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(4)
        )
        for bound in (self.inlet, self.site):
            bound.bind(("127.0.0.1", 0))
            bound.setblocking(False)
        self.robot.connect(self.inlet.getsockname())
        outlet.connect(self.site.getsockname())
        self.hops = Hops.draw()
        self.forwarder = Forwarder(self.hops, self.inlet, outlet)
        self.sealer = Sealer(self.hops.first, Side.CLIENT)
        self.opener = Opener(self.hops.second, Side.RELAY)

    def forward(self, datagram: bytes) -> bytes | None:
        """What the site gets. A datagram is not there yet when `send` returns: the kernel may hand it over later."""
        self.robot.send(datagram)
        assert select.select([self.inlet], [], [], DEADLINE_S)[0], "the forwarder gets it"
        before = self.forwarder.forwarded
        self.forwarder.step()
        if self.forwarder.forwarded == before:
            return None
        assert select.select([self.site], [], [], DEADLINE_S)[0], "what was forwarded arrives"
        return self.site.recv(2048)


@pytest.fixture
def path() -> Iterator[Path3]:
    with ExitStack() as stack:
        yield Path3(stack)


def test_it_opens_what_one_hop_sealed_and_seals_it_for_the_next(path: Path3) -> None:
    for body in (b"p" * 100, b"c" * ROOM_BYTES):
        sealed = path.sealer.seal(body)
        got = path.forward(sealed)
        assert got is not None
        assert len(got) == len(sealed)
        assert got[SEAL_BYTES:] != sealed[SEAL_BYTES:]
        assert Opener(path.hops.first, Side.CLIENT).open(got) is None
        assert path.opener.open(got) == body
    assert path.forwarder.forwarded == 2
    assert not any(path.forwarder.refused.values())


def test_it_refuses_whatever_is_not_sealed_for_it(path: Path3) -> None:
    good = path.sealer.seal(b"once")
    assert path.forward(good) is not None
    assert path.forward(good) is None
    assert path.forward(b"short") is None
    assert path.forward(Sealer(path.hops.second, Side.CLIENT).seal(b"of another session")) is None
    newer = path.sealer.seal(b"changed")
    assert path.forward(newer[:-1] + bytes([newer[-1] ^ 1])) is None
    assert path.forward(path.sealer.seal(b"c" * ROOM_BYTES) + b"longer than any") is None
    refused = path.forwarder.refused
    assert (refused["replayed"], refused["short"], refused["foreign"], refused["bad_tag"]) == (1, 1, 1, 2)
    assert path.forwarder.forwarded == 1


def test_the_keys_of_both_hops_are_handed_over_in_a_file_of_our_own(tmp_path: Path) -> None:
    hops = Hops.draw()
    hops.write(tmp_path)
    assert Hops.read(tmp_path) == hops != Hops.draw()
    assert [path.stat().st_mode & 0o777 for path in tmp_path.iterdir()] == [0o600]


OURS = outcome([], wire_packets=4000, wire_bytes=4000 * 1142, cpu_percent={"robot": 5.0, "relay": 4.0, "site": 9.0})
BARE = outcome([], system="forwarder", wire_packets=4000, cpu_percent={"robot": 3.0, "relay": 1.25, "site": 1.0})
"""4000 datagrams in 10 s at 1.25 % of a core: 31.25 us each."""


def test_the_busier_side_is_told_as_a_multiple_of_the_forwarder() -> None:
    assert figures.forwarding_us(BARE) == pytest.approx(31.25)
    assert figures.times_forwarding(OURS, BARE) == pytest.approx(5.0 / 1.25)
    busier = replace(OURS, cpu_percent={"robot": 5.0, "relay": 10.0})
    assert figures.times_forwarding(busier, BARE) == pytest.approx(8.0)


def test_the_multiple_is_of_as_many_datagrams() -> None:
    """The forwarder had a few less in the same time: it would have taken more for ours."""
    fewer = replace(BARE, wire_packets=3800, cpu_percent={"robot": 3.0, "relay": 0.95 * 1.25})
    assert figures.times_forwarding(OURS, fewer) == pytest.approx(4.0)
    with pytest.raises(SernError, match=r"the bare forwarder carried 300 datagrams/s, sern-udp 400"):
        figures.times_forwarding(OURS, replace(BARE, wire_packets=3000))
    for nothing in (replace(BARE, wire_packets=0), replace(BARE, cpu_percent={"robot": 1.0, "relay": 0.0})):
        with pytest.raises(SernError, match="carried"):
            figures.times_forwarding(OURS, nothing)


def test_the_forwarder_gets_datagrams_of_the_size_and_rate_of_the_run() -> None:
    load = figures.bare_load(OURS)
    assert (load.even_hz, load.even_bytes) == (400.0, 1142 - 42 - SEAL_BYTES)
    (flow,) = load.flows
    assert [(at_s, flow.size_bytes) for at_s, flow, _ in load.schedule(0.0101)] == [
        (0.0, load.even_bytes),
        (0.0025, load.even_bytes),
        (0.005, load.even_bytes),
        (0.0075, load.even_bytes),
    ]
    assert flow.kind is Kind.POSE
    lossy = replace(OURS, model=LinkModel(rate_bps=4e6, loss=0.2))
    assert figures.bare_load(lossy).even_hz == pytest.approx(500.0), "of which as many arrive"
    with pytest.raises(SernError, match="nothing left the link"):
        figures.bare_load(replace(OURS, wire_packets=0))


def test_refusing_is_told_by_what_forwarding_one_costs() -> None:
    assert figures.refusing_to_forwarding(10.0, 20_000, BARE) == pytest.approx(5.0 / 31.25)


def test_a_case_holds_its_cpu_against_a_forwarder_of_the_same_run(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, str, LinkModel, Load]] = []

    def run(_bench: Bench, case: str, system: str, model: LinkModel, load: Load, *_: object, **__: object) -> Outcome:
        asked.append((case, system, model, load))
        return BARE

    monkeypatch.setattr(Bench, "run", run)
    report = Report("link")
    bench = Bench(Lab(), report, ("sern-udp",), quick=True, directory=Path(), plots=None)
    for limit in (5.0, 3.9):
        bench.cpu("4 Mbit/s", OURS, limit)
    assert asked == 2 * [("4 Mbit/s", "forwarder", OURS.model, figures.bare_load(OURS))]
    assert [reach.value for reach in report.reaches] == pytest.approx([4.0, 4.0])
    assert [(reach.limit, reach.ok) for reach in report.reaches] == [(5.0, True), (3.9, False)]
