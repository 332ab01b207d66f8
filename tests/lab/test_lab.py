"""The lab keeps its word: what a profile says is what packets meet, and nothing of it stays behind."""

import math
import os
import signal
import statistics
import subprocess
import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_runtime.profiles import load_profile
from sern_sim.models import BurstLoss, Jitter, LinkModel, RateStep, Window
from sern_sim.profiles import LinkProfile
from sern_tools.lab.backends import MIDDLE, Endpoint, Native, wiring
from sern_tools.lab.host import NETNS_DIR, LabError
from sern_tools.lab.lab import Lab, Node
from sern_tools.lab.removal import RUN_DIR, labs, namespaces, sweep
from tests.lab.traffic import HEADERS_BYTES, comes_to_reach, datagrams, rate_bps, reaches, stream
from tests.support import ended, until

pytestmark = pytest.mark.root
SIGMAS = 5.0
"""How far random losses may lie from their mean: wrong less than once in a million runs."""


def within_binomial(lost: int, count: int, probability: float) -> bool:
    return abs(lost - count * probability) <= SIGMAS * math.sqrt(count * probability * (1 - probability))


@pytest.mark.lab_long
@pytest.mark.parametrize("direction", ["up", "down"])
def test_delay_and_jitter_are_exact(lab: Lab, direction: str) -> None:
    source, target = (lab.a, lab.b) if direction == "up" else (lab.b, lab.a)
    floor = min(arrival.delay_s for arrival in datagrams(source, target, 50, gap_s=0.002))
    lab.change("up", delay_s=0.040)
    lab.change("down", delay_s=0.080, jitter_s=0.010, jitter=Jitter.UNIFORM)
    delays = [arrival.delay_s for arrival in datagrams(source, target, 300, gap_s=0.002)]
    assert len(delays) == 300
    assert floor < 0.002
    if direction == "up":
        assert min(delays) == pytest.approx(0.040, abs=0.001)
        assert statistics.median(delays) == pytest.approx(0.040, abs=0.002)
    else:
        # Order is kept, so a packet waits for the one before it and the delay leans towards its upper end.
        assert 0.069 < min(delays) < 0.080
        assert 0.080 < statistics.median(delays) < 0.092


@pytest.mark.lab_long
@pytest.mark.parametrize("size_bytes", [pytest.param(100, marks=pytest.mark.lab_long), 1200])
def test_rate_is_exact_and_the_queue_is_as_long_as_asked(lab: Lab, size_bytes: int) -> None:
    model = LinkModel(rate_bps=4e6, delay_s=0.010, queue_packets=50)
    lab.link(up=model)
    arrivals = datagrams(lab.a, lab.b, 3000 if size_bytes == 100 else 600, size_bytes=size_bytes, gap_s=0.0002)
    assert rate_bps(arrivals[10:], size_bytes) == pytest.approx(4e6, rel=0.03)
    full = arrivals[len(arrivals) // 2 :]
    limit = model.queue_packets + model.packets_in_delay(1228)
    longest_s = limit * 8 * (size_bytes + HEADERS_BYTES) / 4e6
    assert max(arrival.delay_s for arrival in full) == pytest.approx(longest_s, rel=0.1, abs=0.012)


@pytest.mark.lab_long
def test_tcp_fills_the_link_with_packets_of_ordinary_size(lab: Lab) -> None:
    lab.change(rate_bps=20e6, delay_s=0.005)
    count_bytes = 4_000_000
    took_s = stream(lab.a, lab.b, count_bytes)
    up, down = lab.traffic()
    # Merged packets would be fewer and larger; a full segment is 1514 bytes on Ethernet.
    assert up.bytes / up.packets <= 1514
    assert up.packets >= count_bytes / 1460
    assert down.packets >= up.packets / 4
    assert 8 * count_bytes / took_s <= 20e6 * 1.03


@pytest.mark.parametrize(
    ("model", "bursts"),
    [
        pytest.param(LinkModel(loss=0.05), False, id="loss"),
        pytest.param(LinkModel(burst_loss=BurstLoss(0.01, 0.1, 0.7)), True, id="gemodel", marks=pytest.mark.lab_long),
    ],
)
def test_losses_are_as_many_as_asked(lab: Lab, model: LinkModel, bursts: bool) -> None:
    count = 6000
    lab.link(down=replace(model, queue_packets=1000))
    there = {arrival.number for arrival in datagrams(lab.b, lab.a, count, gap_s=0.0003)}
    lost = count - len(there)
    runs = sum(number not in there and number - 1 in there for number in range(1, count))
    if bursts:
        # Losses of one burst are not independent: the count varies by about 2/leave times as much.
        assert lost == pytest.approx(count * model.mean_loss, rel=0.7)
        assert lost > 2 * runs
    else:
        assert within_binomial(lost, count, 0.05)
        assert lost < 1.3 * runs
    assert len(datagrams(lab.a, lab.b, 500, gap_s=0.0003)) == 500


def test_nothing_is_lost_while_the_guest_does_not_run(lab: Lab) -> None:
    if lab.backend != "appliance":
        pytest.skip("this kernel has netem: the lab needs no guest that could stand still")
    guest = lab._running.guest._process  # type: ignore[attr-defined]
    lab.link(up=LinkModel(queue_packets=3000))
    guest.send_signal(signal.SIGSTOP)
    try:
        resume = partial(guest.send_signal, signal.SIGCONT)
        arrivals = datagrams(lab.a, lab.b, 2000, quiet_s=5.0, then=resume)
    finally:
        guest.send_signal(signal.SIGCONT)
    assert [arrival.number for arrival in arrivals] == list(range(2000))


@pytest.mark.lab_long
def test_duplicates_and_reordering(lab: Lab) -> None:
    lab.change(delay_s=0.010, duplicate=0.1)
    numbers = [arrival.number for arrival in datagrams(lab.a, lab.b, 2000, gap_s=0.0005)]
    assert within_binomial(len(numbers) - 2000, 2000, 0.1)
    lab.change(duplicate=0.0, reorder=0.05)
    numbers = [arrival.number for arrival in datagrams(lab.a, lab.b, 2000, gap_s=0.0005)]
    assert sorted(numbers) == list(range(2000))
    assert numbers != sorted(numbers)


@pytest.mark.lab_long
def test_a_link_changes_while_it_carries(lab: Lab) -> None:
    lab.change(delay_s=0.010)
    seen: list[float] = []

    def send() -> None:
        seen.extend(arrival.delay_s for arrival in datagrams(lab.a, lab.b, 600, gap_s=0.002))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        lab.change("up", delay_s=0.060)
        lab.change("up", jitter_s=0.001, jitter=Jitter.NORMAL)
        lab.change("up", jitter=Jitter.UNIFORM)  # which makes the qdisc anew: what was in it is lost
        lab.change("up", jitter_s=0.0, delay_s=0.030)
    finally:
        thread.join()
    assert len(seen) > 500
    assert min(seen[:50]) < 0.020 and max(seen) > 0.055
    assert statistics.median(seen[-50:]) == pytest.approx(0.030, abs=0.002)
    assert lab.up.delay_s == 0.030 and lab.down.delay_s == 0.010
    with pytest.raises(UsageError, match="loss is 2"):
        lab.change(loss=2.0)
    assert lab.up.loss == 0.0
    assert lab.backend in ("native", "appliance")


def test_blackouts_and_scripts(lab: Lab) -> None:
    lab.blackout(True, "up")
    assert not reaches(lab.a, lab.b)
    assert comes_to_reach(lab.b, lab.a)
    lab.change(delay_s=0.001)
    assert lab.dark == (True, False)
    assert not reaches(lab.a, lab.b)
    lab.blackout(False)
    assert comes_to_reach(lab.a, lab.b)

    script = LinkModel(rate_bps=8e6, rate_steps=(RateStep(0.4, 1e6),), blackouts=(Window(0.8, 3600.0),))
    lab.run_profile(LinkProfile("script", "", script, LinkModel(), 10.0), until_s=1.2)
    assert (lab.up.rate_bps, lab.dark) == (1e6, (True, False))
    lab.apply(load_profile("satcom"))
    assert (lab.up.rate_bps, lab.down.delay_s, lab.dark) == (1e6, 0.25, (False, False))


def test_sides_with_several_namespaces(lab: Lab) -> None:
    lab.change(delay_s=0.050)
    assert min(a.delay_s for a in datagrams(lab["base"], lab["other"], 20, gap_s=0.001)) < 0.005
    assert min(a.delay_s for a in datagrams(lab["rover"], lab["other"], 20, gap_s=0.001)) > 0.049
    route = lab.exec("other", ["ip", "route"]).stdout
    assert "congctl cubic" in route and lab["other"].address in route
    assert lab.exec("rover", ["false"]).returncode == 1
    with pytest.raises(UsageError, match="no node 'nobody'"):
        lab.exec("nobody", ["true"])


def test_native_wiring_on_a_kernel_that_has_netem(lab: Lab) -> None:
    """The guest's kernel can do it: two namespaces and their link, made with the commands of the backend."""
    if lab.backend != "appliance":
        pytest.skip("this kernel has netem: every lab test here uses the native wiring")
    guest = lab._running.guest  # type: ignore[attr-defined]
    ends = [Endpoint("a", "a", 0, 1), Endpoint("b", "b", 1, 1)]
    native = Native("m")
    spaces = ("a", "b", "m")
    for space in spaces:
        guest.command(f"/sbin/ip netns add {space}")
    try:
        for line in [*wiring("m", ends, "cubic"), *native.cable()]:
            guest.command(f"/sbin/{line}")
        for device, delay in zip(native.devices, ("40ms", "10ms"), strict=True):
            guest.command(f"/sbin/tc -n m qdisc replace dev {device} root netem limit 100 delay {delay} rate 100gbit")
        output = guest.command(f"/sbin/ip netns exec a /bin/ping -c 10 -i 0.1 {ends[1].address}")
        fastest_ms = float(output.rpartition("= ")[2].split("/")[0])
        # The guest itself sends, receives and shapes here, on one processor; each delay twice would be 100 ms.
        assert 50.0 <= fastest_ms < 100.0
    finally:
        for space in spaces:
            guest.command(f"/sbin/ip netns del {space}")


OWNER = """
import asyncio, sys
from sern_tools.lab.lab import Lab

async def main():
    async with Lab() as lab:
        child = lab.popen(lab.a, ["sleep", "1000"])
        print(lab.id, child.pid, flush=True)
        sys.stdin.read()

asyncio.run(main())
"""


def piped(*arguments: str) -> subprocess.Popen[str]:
    """This interpreter with `arguments`, and pipes to talk to it."""
    return subprocess.Popen([sys.executable, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def owner_of_a_lab(script: str = OWNER) -> subprocess.Popen[str]:
    """A process that makes a lab and says which, to be killed by the caller."""
    return piped("-c", script)


async def test_two_at_once_and_nothing_stays_after_kill_9(lab: Lab) -> None:
    lab.change(delay_s=0.020)
    with owner_of_a_lab() as owner:
        try:
            assert owner.stdout is not None
            other, child = owner.stdout.readline().split()
            ours, theirs = set(namespaces(lab.id)), set(namespaces(other))
            assert len(theirs) == 3 and not ours & theirs
            assert not {lab.id, other} & set(sweep())  # both live
            # The same addresses, and two links that do not know of each other.
            assert min(a.delay_s for a in datagrams(lab.a, lab.b, 20, gap_s=0.001)) > 0.019
            first, second = (Node(Endpoint(name, f"sern-{other}-{name}", side, 1)) for side, name in enumerate("ab"))
            assert min(a.delay_s for a in datagrams(first, second, 20, gap_s=0.001)) < 0.005
        finally:
            owner.kill()
    # Others on this machine may make and remove labs of their own meanwhile.
    await until(lambda: other not in labs(), "the keeper removes the lab")
    assert lab.id in labs()
    await until(lambda: ended(int(child)), "its process ends")
    await until(lambda: not processes_of(other), "its guest and its keeper end")
    assert not [entry for entry in NETNS_DIR.iterdir() if entry.name in theirs]
    assert not [entry for entry in RUN_DIR.iterdir() if entry.name.startswith(f"{other}.")]


def processes_of(lab: str) -> dict[int, str]:
    """Processes whose command line names the lab, by process id."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                command = (entry / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
            except OSError:
                continue
            if f"sern-{lab}-" in command or f"sern_tools.lab.keeper {lab} " in command:
                found[int(entry.name)] = command
    return found


async def test_the_next_start_removes_what_a_dead_keeper_left(possible: None) -> None:
    with owner_of_a_lab() as owner:
        left = str(owner.pid)
        try:
            # Killed in the middle of its start, keeper first: the owner is held there until its keeper has ended.
            await until(lambda: f"sern-{left}-{MIDDLE}" in [entry.name for entry in NETNS_DIR.iterdir()])
            owner.send_signal(signal.SIGSTOP)
            (keeper,) = (pid for pid, command in processes_of(left).items() if "lab.keeper" in command)
            os.kill(keeper, signal.SIGKILL)
            await until(lambda: ended(keeper), "the keeper ends")
        finally:
            owner.kill()
    assert left in labs()
    await until(lambda: left in sweep(), "the command that makes a namespace ends")
    assert namespaces(left) == [] and left not in labs()
    assert not processes_of(left)


LATE_COMMAND = """
import sys
from sern_tools.lab.host import run
from sern_tools.lab.removal import lock

held = lock(sys.argv[1])
print("held", flush=True)
sys.stdin.readline()
run(["ip", "netns", "add", f"sern-{sys.argv[1]}-late"])
"""


def test_a_keeper_waits_for_the_command_that_its_dead_owner_left(possible: None) -> None:
    """`ip netns add` goes on when the owner is killed: what it makes would stay behind for ever."""
    name = f"{os.getpid()}.999"
    with piped("-c", LATE_COMMAND, name) as command, piped("-P", "-m", "sern_tools.lab.keeper", name) as keeper:
        assert command.stdin is not None and command.stdout is not None and keeper.stdin is not None
        assert command.stdout.readline() == "held\n"
        keeper.stdin.close()  # as by kill -9
        command.stdin.close()
        assert (command.wait(), keeper.wait()) == (0, 0)
    assert namespaces(name) == [] and name not in labs()


def test_errors_name_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setattr("sern_tools.lab.lab.sweep", lambda: pytest.fail("it looks at what is root's"))
    with pytest.raises(LabError, match=r"the lab needs root .*sudo"):
        Lab().start()


def test_names_that_cannot_be() -> None:
    for sides in ([], ["a b"], ["link"], ["b"]):
        with pytest.raises(UsageError):
            Lab(a=sides)
