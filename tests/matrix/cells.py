"""The cells: every named profile, three loads, four faults, one lane or two; and what their links look like.

A profile's script is told in less time: where nothing happens for more than `GAP_S`, the rest is left out. Blackouts
keep their length. The fault comes after the script, so that each is met alone.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import product

from sern_runtime.profiles import load_profiles
from sern_sim.models import BurstLoss, Flap, LinkModel, RateStep, Window
from sern_sim.profiles import LinkProfile

SETTLE_S = 6.0
"""Calm in which everybody connects; the load begins after it, and the script with it."""
GAP_S = 1.5
TAIL_S = 2.5
"""Load after the last fault: recovery happens under it."""
BLACKOUT_S = 6.0
"""Longer than a stream connection lasts without its path."""
HARSH = BurstLoss(enter=0.008, leave=0.12, bad_loss=0.7)
"""Bursts of about eight packets, 4.4 % in the mean."""
THIN_BPS = 4e6
"""Under overload faster links are played at this rate: a datagram costs the same at any rate, and a gigabit is a
hundred thousand of them a second."""
THINNED = {
    "lan": "1 Gbit/s overloaded is 10^5 datagrams a second of virtual time; played at 4 Mbit/s, delay and queue kept",
    "wifi": "50 Mbit/s overloaded is 5000 datagrams a second of virtual time; played at 4 Mbit/s, the rest kept",
    "lte": "8 Mbit/s; played at 4 Mbit/s, the rest kept",
    "step": "8, 1, 4 Mbit/s; played at 4, 1, 4 Mbit/s",
}
"""Profiles whose rate is lowered when they are overloaded, and why."""


class Load(StrEnum):
    """What is offered, as a multiple of the link's rate: `clouds` of class bulk, `costmaps` of class state. The rest
    fits through the link."""

    IDLE = "idle"
    TWICE = "2x"
    THIRTEEN = "13x"

    @property
    def clouds(self) -> float:
        return {Load.IDLE: 0.0, Load.TWICE: 2.0, Load.THIRTEEN: 8.0}[self]

    @property
    def costmaps(self) -> float:
        return {Load.IDLE: 0.0, Load.TWICE: 0.0, Load.THIRTEEN: 5.0}[self]


class Fault(StrEnum):
    NONE = "none"
    BLACKOUT = "blackout"
    FLAP = "flap"
    BURST = "burst"


class Lanes(StrEnum):
    STREAM = "stream"
    BOTH = "both"


@dataclass(frozen=True)
class Cell:
    profile: str
    load: Load
    fault: Fault
    lanes: Lanes

    def __str__(self) -> str:
        return f"{self.profile}-{self.load}-{self.fault}-{self.lanes}"

    @property
    def seed(self) -> int:
        return 1 + CELLS.index(self)

    @property
    def impossible(self) -> dict[str, str]:
        """Topics of which nothing can arrive in this cell, and why not."""
        return {topic: reason for applies, topic, reason in IMPOSSIBLE if applies(self)}

    @property
    def in_every_run(self) -> bool:
        """A Latin square over the faults: each profile with each load and lane, each fault in its turn."""
        turn = [*PROFILES].index(self.profile) + [*Load].index(self.load) + 2 * [*Lanes].index(self.lanes)
        return [*Fault].index(self.fault) == turn % len(Fault)


@dataclass(frozen=True)
class Path:
    """The robot's link in a cell: both directions as datagrams, when the faults are over, and what it is at worst."""

    up: LinkModel
    down: LinkModel
    faults_end_s: float
    lowest_bps: float
    highest_bps: float
    rtt_s: float

    @property
    def load_end_s(self) -> float:
        return self.faults_end_s + TAIL_S

    @property
    def lossy(self) -> bool:
        return bool(self.up.mean_loss or self.down.mean_loss)


IMPOSSIBLE: tuple[tuple[Callable[[Cell], bool], str, str], ...] = (
    (
        lambda cell: cell.lanes is Lanes.STREAM and cell.load is not Load.IDLE and path_of(cell).lossy,
        "/robot/points",
        "each lost segment stalls a stream for a round trip and 0.2 s; of what it carries then, the share that is left "
        "to class bulk may bring no cloud across within its lifespan of 3 s",
    ),
    (
        lambda cell: cell.lanes is Lanes.STREAM and cell.load is Load.THIRTEEN and path_of(cell).lossy,
        "/robot/costmap",
        "lost segments leave a stream as little as 150 to 400 kbit/s, of which a costmap of 100 kB within 3 s is most: "
        "of the twenty that are offered one to three arrive, and with bad luck none",
    ),
)
"""What may not work: in which cells, of which topic nothing may arrive, and the reason. It is still promised there that
each drop is counted, and everything else."""
PROFILES = load_profiles()
CELLS = [Cell(*axes) for axes in product(PROFILES, Load, Fault, Lanes)]


def path_of(cell: Cell) -> Path:
    profile = PROFILES[cell.profile]
    end_s, times = SETTLE_S, {0.0: SETTLE_S}
    for at_s, next_s, dark in _script(profile):
        end_s += next_s - at_s if dark else min(next_s - at_s, GAP_S)
        times[next_s] = end_s
    if profile.up.flap is not None:
        end_s += 4.0
    end_s += GAP_S
    fault: tuple[Window, ...] = ()
    if cell.fault is Fault.BLACKOUT:
        fault = (Window(end_s, end_s + BLACKOUT_S),)
    elif cell.fault is Fault.FLAP:
        fault = tuple(Window(end_s + 0.9 * n, end_s + 0.9 * n + 0.45) for n in range(5))
    end_s = fault[-1].end_s if fault else end_s
    up, down = (_model(model, times, fault, cell, end_s) for model in (profile.up, profile.down))
    rates = [rate for model in (up, down) for rate in _rates(model)]
    return Path(up, down, end_s, min(rates), max(rates), profile.rtt_s + 2 * (up.jitter_s + down.jitter_s))


def _script(profile: LinkProfile) -> Iterator[tuple[float, float, bool]]:
    """The stretches between one change of the link and the next, and whether it is gone; a flap is not a script."""
    if profile.up.flap is not None:
        return
    at_s = 0.0
    while (next_s := profile.next_change_s(at_s)) is not None:
        yield at_s, next_s, profile.blackout_at(at_s)
        at_s = next_s


def _model(
    model: LinkModel, times: dict[float, float], fault: tuple[Window, ...], cell: Cell, end_s: float
) -> LinkModel:
    windows = tuple(Window(times[each.start_s], times[each.end_s]) for each in model.blackouts)
    if model.flap is not None:
        windows = tuple(_flaps(model.flap, end_s if not fault else fault[0].start_s))
    model = replace(
        model,
        flap=None,
        blackouts=(*windows, *fault),
        rate_steps=tuple(RateStep(times[step.at_s], step.rate_bps) for step in model.rate_steps),
        burst_loss=HARSH if cell.fault is Fault.BURST else model.burst_loss,
    )
    if cell.load is Load.IDLE or cell.profile not in THINNED:
        return model
    steps = tuple(RateStep(step.at_s, min(step.rate_bps or THIN_BPS, THIN_BPS)) for step in model.rate_steps)
    return replace(model, rate_bps=min(model.rate_bps or THIN_BPS, THIN_BPS), rate_steps=steps)


def _flaps(flap: Flap, until_s: float) -> Iterator[Window]:
    start_s = SETTLE_S + flap.up_s
    while start_s + flap.down_s <= until_s:
        yield Window(start_s, start_s + flap.down_s)
        start_s += flap.up_s + flap.down_s


def _rates(model: LinkModel) -> list[float]:
    rates = [model.rate_bps, *(step.rate_bps for step in model.rate_steps)]
    return [1e9 if rate is None else rate for rate in rates]
