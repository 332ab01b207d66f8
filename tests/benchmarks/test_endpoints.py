"""What the endpoints' benchmark starts, reckons and limits, without a ROS system."""

import argparse
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks import child
from benchmarks.common import MissingError, Report
from benchmarks.endpoints import __main__ as endpoints
from benchmarks.endpoints import ros1, shared
from benchmarks.endpoints.ros1_roles import figures
from benchmarks.endpoints.shared import ALONE, CHAIN, DIRECT, ROBOT, SITE, Rounds
from sern_core.vocabulary.errors import SernError
from sern_runtime.config.client import load_client
from sern_runtime.config.keys import load_public
from sern_runtime.config.relay import load_relay
from sern_tools.harness.processes import Child, Children, python
from tests.support import DEADLINE_S

PYTHON = sys.executable
need = ros1.need


class Written(Children):
    """Children that are not started."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.commands: dict[str, Sequence[str]] = {}

    async def start(
        self,
        name: str,
        command: Sequence[str],
        *,
        talks: bool = False,
        environment: Mapping[str, str | None] | None = None,
    ) -> Child:
        assert environment is not None and environment["PYTHONPATH"] is not None and not talks
        self.commands[name] = command
        return Child(name, None, self.directory / f"{name}.log")  # type: ignore[arg-type]


async def test_the_chain_is_a_relay_and_two_clients_with_keys(tmp_path: Path) -> None:
    children = Written(tmp_path)
    sections = {name: {"kind": "ros1", "master_uri": f"http://{shared.HOST}:11311"} for name in (ROBOT, SITE)}
    daemons = await shared.start_chain(children, sections, {}, reliability="reliable")
    assert [daemon.name for daemon in daemons] == ["relay", ROBOT, SITE] == list(children.commands)
    for name, command in children.commands.items():
        program = "relay" if name == "relay" else "client"
        assert command == [PYTHON, "-P", "-m", f"sern_{program}.cli", "--config", str(tmp_path / f"{name}.yaml")]
    relay = load_relay(tmp_path / "relay.yaml").model
    robot, site = (load_client(tmp_path / f"{name}.yaml").model for name in (ROBOT, SITE))
    assert [client.all_relays[0].endpoint for client in (robot, site)] == list(relay.relay.listen) * 2
    assert {path.stem for path in (tmp_path / "clients").iterdir()} == {ROBOT, SITE}
    assert load_public(tmp_path / "relay.pub").name == "relay"
    assert (robot.subscribe, site.subscribe) == ((), ("/bench/.*",))
    for client in (robot, site):
        assert [(rule.match, rule.priority, rule.reliability) for rule in client.topics] == [
            (".*/odom", "control", "reliable"),
            (".*/cloud", "bulk", "reliable"),
        ]


def run(odom_ms: float, cpu: float, lost: int = 0) -> dict[str, float]:
    return {"odom_p50_ms": odom_ms, "odom_lost": lost, "cpu_percent": cpu}


def test_what_is_added_is_reckoned_within_a_round_and_losses_do_not_hide() -> None:
    rounds = Rounds({
        DIRECT: [run(1.0, 0.0), run(2.0, 0.0), run(9.0, 0.0)],
        CHAIN: [run(1.5, 10.0), run(2.25, 30.0, lost=7), run(10.0, 20.0)],
        ALONE: [run(1.0, 5.0), run(2.0, 5.0), run(9.0, 5.0)],
    })  # fmt: skip
    assert rounds.figures(CHAIN) == {
        "odom_p50_ms": 2.25,
        "odom_added_ms": 0.5,
        "odom_added_spread_ms": 0.75,
        "odom_lost": 7,
        "cpu_percent": 20.0,
        "cpu_spread_percent": 20.0,
    }
    assert rounds.times(CHAIN, ALONE, "cpu_percent") == 4.0
    once = Rounds({name: runs[:1] for name, runs in rounds.runs.items()})
    assert once.figures(CHAIN) == {"odom_p50_ms": 1.5, "odom_added_ms": 0.5, "odom_lost": 0, "cpu_percent": 10.0}


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, float]]:
    """A machine with all of ROS 1, and what is measured there, by system."""
    figures = {
        DIRECT: run(0.1, 0.0),
        CHAIN: run(0.7, 100.0, lost=2),
        ALONE: run(0.2, 3.0),
        ros1.TOPIC_TOOLS: run(0.2, 4.0),
        ros1.ROSPY: run(0.3, 5.0),
        ros1.ZENOH: run(0.4, 10.0),
    }

    async def follow(_measure_s: float) -> dict[str, float]:
        return {"found_s": 1.0, "cpu_percent": 0.5, "master_cpu_percent": 0.5, "bare_cpu_percent": 2.0}

    async def usable() -> None:
        return

    monkeypatch.setattr(ros1, "need", lambda *_paths: None)
    monkeypatch.setattr(ros1, "measure", lambda system, _load, _measure_s: figures[system])
    monkeypatch.setattr(ros1, "_follow", follow)
    monkeypatch.setattr(ros1, "_try_zenoh", usable)
    return figures


OPTIONS = argparse.Namespace(quick=True, rounds=2)


@pytest.mark.usefixtures("machine")
def test_limits_are_of_the_chain_and_a_miss_is_said() -> None:
    report = Report("endpoints")
    ros1.bench(OPTIONS, report)
    assert [(reach.name, reach.value, reach.limit, reach.ok) for reach in report.reaches] == [
        ("ros1: latency added to odometry [ms]", pytest.approx(0.6), 0.5, False),
        ("ros1: CPU beside the rospy bridge", 20.0, 0.7, False),
        ("ros1: lost at 3 kHz", 2, 0, False),
        ("ros1, in one process: latency added to odometry [ms]", pytest.approx(0.1), 0.5, True),
        ("ros1, in one process: CPU beside the rospy bridge", 0.6, 0.7, True),
        ("ros1, in one process: lost at 3 kHz", 0, 0, True),
        ("ros1, one endpoint: CPU with 300 topics, times a bare poller's", 0.25, 0.5, True),
    ]
    out = StringIO()
    report.print(Console(file=out, width=140))
    assert "MISSED   ros1: CPU beside the rospy bridge: 20 (wanted ≤ 0.7)" in out.getvalue()
    assert "MISSED   ros1: lost at 3 kHz: 2 (wanted ≤ 0)" in out.getvalue()


def test_a_peer_that_is_not_installed_is_left_out_and_named(
    machine: dict[str, dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = [path for path in ros1.PACKAGES if not path.endswith(("rospy", "nav_msgs", "relay"))]
    monkeypatch.setattr(ros1, "need", need)
    monkeypatch.setattr(Path, "exists", lambda path: str(path) in installed)
    report = Report("endpoints")
    ros1.bench(OPTIONS, report)
    monkeypatch.undo()
    assert {row.system for row in report.rows} == {DIRECT, CHAIN, ALONE, "sern-endpoint"}
    assert set(machine) - {row.system for row in report.rows} == {ros1.TOPIC_TOOLS, ros1.ROSPY, ros1.ZENOH}
    assert "ros1 without topic_tools: needs the Debian packages topic-tools" in report.notes
    assert "ros1 without rospy: needs the Debian packages python3-rospy python3-nav-msgs" in report.notes
    assert "ros1 without rospy+zenoh: needs the Debian packages python3-rospy python3-nav-msgs" in report.notes
    assert not [reach.name for reach in report.reaches if "rospy" in reach.name], "there is nothing to be beside"


async def test_a_python_that_cannot_use_zenoh_is_named_with_its_words(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    other = tmp_path / "python3"
    other.write_text(f'#!/bin/sh\nexec {PYTHON} -S "$@"\n')  # which does not have what is installed here
    other.chmod(0o755)
    monkeypatch.setattr(ros1, "DEBIAN_PYTHON", str(other))
    monkeypatch.setattr(shared, "zenoh_folder", lambda: tmp_path)
    (tmp_path / "zenoh.py").write_text("")
    await ros1._try_zenoh()
    (tmp_path / "zenoh.py").write_text("raise ImportError('built for another Python')")
    with pytest.raises(MissingError, match=r"python3 cannot use .*\(.*: ImportError: built for another Python\)$"):
        await ros1._try_zenoh()


def test_a_part_that_cannot_be_measured_leaves_the_rest(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name, text in (
        ("first", "import not_installed"),
        ("second", "def bench(options, report): report.row('case', 'system', found_s=1.0)"),
        (
            "third",
            "from benchmarks.common import MissingError\ndef bench(*_): raise MissingError('needs the package x')",
        ),
        ("fourth", "import benchmarks.nothing"),
    ):
        (tmp_path / f"{name}.py").write_text(text)
    package = sys.modules["benchmarks.endpoints"]
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    monkeypatch.setattr(endpoints, "PARTS", ("first", "second", "third"))
    report = Report("endpoints")
    endpoints.run(argparse.Namespace(quick=True, rounds=None, only=None), report)
    assert [row.metrics for row in report.rows] == [{"found_s": 1.0}]
    missing = ["first left out: needs the Python package not_installed", "third left out: needs the package x"]
    assert report.notes[:2] == missing
    with pytest.raises(SernError, match="; ".join(missing)):
        endpoints.run(argparse.Namespace(quick=True, rounds=None, only=["first", "third"]), Report("endpoints"))
    with pytest.raises(ModuleNotFoundError, match=r"benchmarks\.nothing"):
        endpoints.run(argparse.Namespace(quick=True, rounds=None, only=["fourth"]), Report("endpoints"))
    for name in ("first", "second", "third", "fourth"):
        sys.modules.pop(f"benchmarks.endpoints.{name}", None)


def test_rospy_nodes_need_nothing_but_what_their_python_has() -> None:
    program = f"import sys; sys.path.append({str(child.ROOT)!r}); import benchmarks.endpoints.rospy_roles as a"
    program += "; print(a.QUEUE, 'site' in sys.modules)"
    command = [sys.executable, "-I", "-S", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert (done.stdout, done.stderr) == ("1000 False\n", "")


def test_lost_is_what_is_missing_in_between() -> None:
    noted = [(3, 4_000_000), (4, 1_000_000), (4, 3_000_000), (9, 2_000_000)]
    assert figures("odom", noted) == {
        "odom_p50_ms": 2.5,
        "odom_p99_ms": 4.0,
        "odom_received": 4,
        "odom_lost": 4,
    }
    assert figures("cloud", []) == {"cloud_received": 0}


def test_a_figure_that_a_round_does_not_have_is_left_out() -> None:
    clouds = {"cloud_p50_ms": 3.0, "cloud_received": 4, "cloud_lost": 0}
    rounds = Rounds(
        {DIRECT: [run(1.0, 0.0)] * 2, CHAIN: [run(1.5, 1.0) | clouds, run(1.5, 1.0) | {"cloud_received": 0}]}
    )
    assert [name for name in rounds.figures(CHAIN) if name.startswith("cloud")] == ["cloud_received"]
    assert rounds.figures(CHAIN)["cloud_received"] == 2


async def test_what_was_started_has_ended_and_its_folder_is_gone() -> None:
    async with shared.started() as children:
        process = await children.start("child", python("-c", "print('{}', flush=True); input()"), talks=True)
        await process.read_object()
        folder = children.directory
        assert process.running and folder.is_dir()
    assert process.process.returncode == -signal.SIGKILL
    assert not folder.exists()


def test_cases_of_other_metrics_have_a_table_of_their_own() -> None:
    report = Report("endpoints")
    report.row("fast", "direct", odom_p50_ms=1.0)
    report.row("fast", "sern", odom_p50_ms=2.0, cpu_percent=3.0)
    report.row("slow", "sern", cpu_percent=3.0, odom_p50_ms=2.0)
    report.row("new topic", "sern", first_s=0.25)
    out = StringIO()
    report.print(Console(file=out, width=100))
    lines = out.getvalue().splitlines()
    heads = [[word.strip() for word in line.strip("┃").split("┃")] for line in lines if line.startswith("┃")]
    assert heads == [["case", "system", "odom p50 [ms]", "cpu [%]"], ["case", "system", "first [s]"]]
