"""The live picture: rates from counters, a table that fits 80x24, plain lines without a terminal."""

import io

import pytest
from rich.console import Console

from sern_runtime.profiles import load_profile
from sern_tools.demo_live import LiveView, Sample, TopicSample, age, join, phase, rate, rows

DEMO = load_profile("demo")


def sample(t_s: float, turns: int) -> Sample:
    topics = {
        "/robot/odometry/filtered": TopicSample("control", turns * 50, turns * 49, turns * 36_000, {}, 0.031),
        "/robot/cmd_vel": TopicSample("control", turns * 10, turns * 10, turns * 500, {"lifespan": 3}, 0.5),
        "/robot/map": TopicSample("state", turns, turns, turns * 20_000, {}, 1.25),
        "/robot/points": TopicSample("bulk", turns * 10, turns * 4, turns * 400_000, {"superseded": 60, "lifespan": 9}),
    }
    return Sample(t_s, topics, 4e6, 3.9e6, 103_000, 12, 0.053)


def test_rates_are_differences_of_counters_and_classes_are_sums() -> None:
    classes, topics = rows(sample(10, 10), sample(12, 12))
    assert [row.name for row in classes] == ["control", "state", "bulk"]
    control = classes[0]
    assert (control.offered_hz, control.delivered_hz) == (60, 59)
    assert control.delivered_bps == 36_500 * 8
    assert (control.age_s, control.dropped) == (0.5, 3)
    assert [row.name for row in topics][:2] == ["/robot/cmd_vel", "/robot/odometry/filtered"]
    assert classes[2].reasons == {"superseded": 60, "lifespan": 9}
    assert classes[2].age_s is None


def test_counters_of_sender_and_receiver_are_joined() -> None:
    robot = {
        "/p": {"class": "control", "direction": "send", "offered": 10, "delivered": 9, "dropped": {"lifespan": 1}},
        "/c": {"class": "control", "direction": "receive", "delivered": 4, "bytes_delivered": 40, "dropped": {}},
    }
    site = {
        "/p": {"class": "control", "direction": "receive", "delivered": 8, "bytes_delivered": 80, "age_s": 0.2,
               "dropped": {"lifespan": 1, "duplicate": 5}},
        "/c": {"class": "control", "direction": "send", "offered": 5, "delivered": 4, "dropped": {"superseded": 0}},
    }  # fmt: skip
    assert join(robot, site) == {
        "/p": TopicSample("control", 10, 8, 80, {"lifespan": 2}, 0.2),
        "/c": TopicSample("control", 5, 4, 40),
    }


def terminal(*, interactive: bool) -> Console:
    return Console(file=io.StringIO(), width=80, height=24, force_terminal=interactive, color_system=None)


def test_the_table_fits_80x24() -> None:
    console = terminal(interactive=False)
    view = LiveView(console, "SERN", DEMO, 60, namespace="/robot")
    console.print(view.render(sample(29, 10), sample(29.4, 11)))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert len(lines) <= 24
    assert max(len(line) for line in lines) <= 80
    text = "\n".join(lines)
    for words in ("SERN", "blackout in 3 s", "/odometry/filtered", "superseded, lifespan", "RTT 53 ms", "29 / 60 s"):
        assert words in text
    assert "…" not in text


def test_without_a_terminal_there_is_a_line_now_and_then() -> None:
    console = terminal(interactive=False)
    with LiveView(console, "SERN", DEMO, 60) as view:
        for tenth in range(120):
            view.show(sample(tenth / 10, tenth))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[1].startswith("  5.0 s  4 Mbit/s, 1 Mbit/s in 7 s  |  control 590/600 Hz")


def test_on_a_terminal_the_table_is_gone_at_the_end() -> None:
    console = terminal(interactive=True)
    with LiveView(console, "SERN", DEMO, 60) as view:
        view.show(sample(1, 1))
        view.show(sample(2, 2))
    assert isinstance(console.file, io.StringIO)
    assert "control" in console.file.getvalue()


@pytest.mark.parametrize(
    ("t_s", "words"),
    [
        (-1, "before the start"),
        (1, "4 Mbit/s"),
        (5, "4 Mbit/s, 1 Mbit/s in 7 s"),
        (20, "1 Mbit/s, 4 Mbit/s in 4 s"),
        (30, "4 Mbit/s, blackout in 2 s"),
        (33.2, "BLACKOUT, 9 s to go"),
        (50, "4 Mbit/s"),
    ],
)
def test_the_phase_in_words(t_s: float, words: str) -> None:
    assert phase(DEMO, t_s) == words


def test_numbers_in_words() -> None:
    assert [rate(bps) for bps in (None, 64e3, 999_900, 12.3e6)] == ["unlimited", "64 kbit/s", "1 Mbit/s", "12.3 Mbit/s"]
    assert [age(s) for s in (None, float("nan"), 0.0264, 12.34)] == ["-", "-", "26 ms", "12.3 s"]
