"""Link models and profiles as plain data, and as tc commands."""

import math
from dataclasses import replace

import pytest

from sern_core.vocabulary.errors import UsageError
from sern_sim.models import BurstLoss, Flap, Jitter, LinkMode, LinkModel, RateStep, Window
from sern_sim.netem import netem_commands, netem_options, netem_removal, netem_timeline
from sern_sim.profiles import LinkProfile

STEPPED = LinkModel(
    rate_bps=8e6, rate_steps=(RateStep(20, 1e6), RateStep(40, 4e6)), blackouts=(Window(30, 35), Window(50, 60))
)


# ---------------------------------------------------------------------- models


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"loss": 2}, "loss is 2: give a probability"),
        ({"loss": math.nan}, "loss is nan"),
        ({"reorder": -0.1}, "reorder is -0.1"),
        ({"duplicate": 1.1}, "duplicate is 1.1"),
        ({"delay_s": -1}, "delay_s is -1: give a time"),
        ({"jitter_s": math.inf}, "jitter_s is inf"),
        ({"rate_bps": 0}, "rate_bps is 0: give bits per second"),
        ({"rate_bps": math.nan}, "rate_bps is nan"),
        ({"queue_packets": 0}, "queue_packets is 0: give 1 or more"),
        ({"overhead_bytes": -1}, "overhead_bytes is -1"),
        ({"burst_loss": BurstLoss(0.1, 0.0)}, "burst_loss.leave is 0: a burst must end"),
        ({"burst_loss": BurstLoss(0.1, 0.5, 70)}, "burst_loss.bad_loss is 70"),
        ({"rate_steps": (RateStep(2, 1e6), RateStep(1, 1e6))}, "rate_steps: the step at 1 s is out of order"),
        ({"rate_steps": (RateStep(2, 1e6), RateStep(2, 1e6))}, "rate_steps: the step at 2 s is out of order"),
        ({"rate_steps": (RateStep(-1, 1e6),)}, "rate_steps: the step at -1 s is out of order"),
        ({"rate_steps": (RateStep(1, 0.5),)}, "rate_steps is 0.5"),
        ({"blackouts": (Window(2, 2),)}, "blackouts: 2 to 2 s is empty"),
        ({"blackouts": (Window(1, 2), Window(2, 3))}, "blackouts: 2 to 3 s is empty, or meets"),
        ({"blackouts": (Window(1, 5), Window(2, 3))}, "blackouts: 2 to 3 s is empty, or meets"),
        ({"flap": Flap(0, 1)}, "flap: give up_s and down_s above 0"),
        ({"flap": Flap(1, 1), "blackouts": (Window(1, 2),)}, "flap and blackouts exclude each other"),
        ({"loss": 1.0, "mode": LinkMode.STREAM}, "loss is 1 in stream mode"),
    ],
)
def test_nonsense_is_refused_by_name(fields: dict[str, object], problem: str) -> None:
    with pytest.raises(UsageError) as caught:
        replace(LinkModel(), **fields)  # type: ignore[arg-type]
    assert str(caught.value).startswith(problem)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("t_s", "rate_bps"), [(0, 8e6), (19.999, 8e6), (20, 1e6), (39, 1e6), (40, 4e6), (1e6, 4e6)])
def test_rate_at(t_s: float, rate_bps: float) -> None:
    assert STEPPED.rate_bps_at(t_s) == rate_bps


def test_blackouts_are_half_open() -> None:
    gone = [t for t in range(70) if STEPPED.blackout_at(t)]
    assert gone == [*range(30, 35), *range(50, 60)]
    assert STEPPED.next_blackout(35) == Window(50, 60)
    assert STEPPED.next_blackout(60) is None


def test_changes_come_one_after_the_other() -> None:
    changes: list[float] = []
    t_s = STEPPED.next_change_s(0.0)
    while t_s is not None:
        changes.append(t_s)
        t_s = STEPPED.next_change_s(t_s)
    assert changes == [20, 30, 35, 40, 50, 60]


def test_a_flap_never_ends() -> None:
    model = LinkModel(flap=Flap(up_s=1.0, down_s=0.25, start_s=3.0))
    assert [t / 4 for t in range(40) if model.blackout_at(t / 4)] == [4.0, 5.25, 6.5, 7.75, 9.0]
    assert [model.next_change_s(t) for t in (1000.0, 1000.25, 1000.5)] == [1000.25, 1000.5, 1001.5]
    # Floats at the edges of periods: every edge is found, none twice.
    edges: list[float] = []
    t_s: float | None = 0.0
    odd = LinkModel(flap=Flap(0.1, 0.2))
    while t_s is not None and len(edges) < 1000:
        t_s = odd.next_change_s(t_s)
        assert t_s is not None
        edges.append(t_s)
    assert edges == sorted(set(edges))
    assert edges[-1] == pytest.approx(150.0)


def test_capacity_leaves_blackouts_out() -> None:
    assert STEPPED.capacity_bits(0, 70) == pytest.approx(20 * 8e6 + 15 * 1e6 + 20 * 4e6)
    assert STEPPED.capacity_bits(32, 33) == 0.0
    assert LinkModel().capacity_bits(0, 1) == math.inf
    assert LinkModel(rate_bps=1e6, flap=Flap(1, 1)).capacity_bits(0.5, 3.5) == pytest.approx(1.5e6)


def test_mean_loss_combines_both_kinds() -> None:
    assert LinkModel(loss=0.02).mean_loss == 0.02
    burst = BurstLoss(0.1, 0.3, 0.8, 0.1)  # a quarter of the time in the bad state
    assert burst.mean_loss == pytest.approx(0.25 * 0.8 + 0.75 * 0.1)
    assert LinkModel(loss=0.5, burst_loss=burst).mean_loss == pytest.approx(1 - 0.5 * (1 - burst.mean_loss))


# ---------------------------------------------------------------------- profiles


def test_a_profile_answers_for_both_directions() -> None:
    down = LinkModel(rate_bps=2e6, delay_s=0.03, blackouts=(Window(5, 6),))
    profile = LinkProfile("test", "A test", up=replace(STEPPED, delay_s=0.02, queue_packets=7), down=down)
    assert not profile.symmetric
    assert profile.rtt_s == 0.05
    assert (profile.delay_s, profile.queue_packets, profile.rate_bps_at(25)) == (0.02, 7, 1e6)
    assert [profile.blackout_at(t) for t in (4, 5, 6, 30)] == [False, True, False, True]
    assert profile.next_change_s(0) == 5
    assert profile.next_change_s(60) is None
    stream = profile.as_stream(disconnect_after_s=3.0)
    assert stream.up.streaming and stream.down.streaming
    assert (stream.up.disconnect_after_s, stream.up.reconnect_s) == (3.0, profile.up.reconnect_s)
    with pytest.raises(UsageError, match="duration_s is 0"):
        replace(profile, duration_s=0)


# ---------------------------------------------------------------------- tc netem


@pytest.mark.parametrize(
    ("model", "options"),
    [
        (LinkModel(), "limit 100"),
        (LinkModel(rate_bps=4e6, delay_s=0.025, loss=0.02), "limit 111 delay 25ms loss 2% rate 4mbit"),
        (LinkModel(rate_bps=1234567, queue_packets=5), "limit 5 rate 1234567bit"),
        (LinkModel(rate_bps=500_000, delay_s=0.00375), "limit 101 delay 3.75ms rate 500kbit"),
        (LinkModel(delay_s=0.03, jitter_s=0.005, jitter=Jitter.UNIFORM), "limit 100 delay 30ms 5ms"),
        (LinkModel(delay_s=0.03, jitter_s=0.005), "limit 100 delay 30ms 5ms distribution normal"),
        (LinkModel(burst_loss=BurstLoss(0.0045, 0.1, 0.7)), "limit 100 loss gemodel 0.45% 10% 70% 0%"),
        (LinkModel(loss=0.5, burst_loss=BurstLoss(0.01, 0.1, 0.6, 0.2)), "limit 100 loss gemodel 1% 10% 80% 60%"),
        (LinkModel(delay_s=0.01, reorder=0.25, duplicate=0.01), "limit 100 delay 10ms duplicate 1% reorder 25%"),
        (LinkModel(blackouts=(Window(0, 1),)), "limit 100 loss 100%"),
        (LinkModel(rate_steps=(RateStep(1, 1e6),)), "limit 100 rate 100gbit"),
    ],
)
def test_netem_options(model: LinkModel, options: str) -> None:
    assert netem_options(model, 0.0) == options


def test_a_script_becomes_commands_with_pauses() -> None:
    up = LinkModel(rate_bps=4e6, rate_steps=(RateStep(12, 1e6), RateStep(24.5, 4e6)), blackouts=(Window(32, 42),))
    profile = LinkProfile("demo", "A demo", up=up, down=LinkModel(delay_s=0.5), duration_s=40)
    change = "tc qdisc change dev eth0 root netem limit 100"
    assert netem_commands(profile, "eth0") == [
        "tc qdisc replace dev eth0 root netem limit 100 loss 0% rate 4mbit",
        "sleep 12",
        f"{change} loss 0% rate 1mbit",
        "sleep 12.5",
        f"{change} loss 0% rate 4mbit",
        "sleep 7.5",
        f"{change} loss 100% rate 4mbit",
    ]
    assert netem_commands(profile, "eth0", down=True) == ["tc qdisc replace dev eth0 root netem limit 100 delay 500ms"]
    assert [at_s for at_s, _ in netem_timeline(up, "eth0", until_s=100)] == [0, 12, 24.5, 32, 42]
    assert netem_removal("eth0") == "tc qdisc del dev eth0 root"


@pytest.mark.parametrize("dev", ["", "eth0; reboot", "a-name-longer-than-15", "eth 0"])
def test_a_device_name_is_a_device_name(dev: str) -> None:
    with pytest.raises(UsageError, match="is not a network device"):
        netem_timeline(LinkModel(), dev, until_s=1)
    with pytest.raises(UsageError, match="is not a network device"):
        netem_removal(dev)
