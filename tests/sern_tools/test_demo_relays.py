"""`sern demo --relays`: its files, what is made of its logs, and a short run of real processes.

Figures of the run are not judged here (the machine may be busy); what does not depend on speed is.
"""

import json
import math
import signal
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from rich.console import Console

from sern_runtime.config.base import FileModel
from sern_runtime.config.client import ClientFile
from sern_runtime.config.load import check_bytes
from sern_runtime.config.relay import RelayFile
from sern_tools.demo import EXIT_BROKEN, EXIT_ERROR, EXIT_INTERRUPTED, EXIT_OK, demo
from sern_tools.demo_relays import CLIENTS, COMMAND, RelaysOptions, contents, streams
from sern_tools.demo_relays_report import Move, RelaysReport, Run, as_json, judged, show
from sern_tools.message_log import Delivery, Offer, TopicLog
from tests.sern_tools.test_demo_run import Started

S = 1_000_000_000
ORIGIN_NS = 1_700_000_000 * S
KILL_S, END_S = 10, 20
LOG, POSE = "/robot1/log", "/robot1/odometry/filtered"
RUN = Run(
    killed="relay1",
    origin_ns=ORIGIN_NS,
    kill_ns=ORIGIN_NS + KILL_S * S,
    end_ns=ORIGIN_NS + END_S * S,
    before={"robot1": "relay1", "robot2": "relay2", "site": "relay3"},
    after={"robot1": "relay2", "robot2": "relay2", "site": "relay3"},
    moves=(Move("robot1", "relay2", 2.4),),
)
INDEPENDENT_OF_SPEED = {"reliable_faults", "corrupted_messages"}


def options(count: int, tmp_path: Path) -> RelaysOptions:
    return RelaysOptions(count, 20.0, 1, tmp_path, tmp_path / "result.json", False, "sern demo")


@pytest.mark.parametrize("count", [2, 3, 5])
def test_its_files_are_right(count: int, tmp_path: Path) -> None:
    asked = options(count, tmp_path)
    names = asked.names
    daemons = (*names, *CLIENTS)
    ports = {name: 20_000 + number for number, name in enumerate(names)}
    ports |= {f"{name}/http": 20_100 + number for number, name in enumerate(daemons)}
    between = {name: 20_200 + number for number, name in enumerate(names)}
    models: dict[str, FileModel] = {}
    for name, content in contents(asked, ports, between).items():
        kind: type[FileModel] = RelayFile if name in names else ClientFile
        checked = check_bytes(json.dumps(content).encode(), tmp_path / f"{name}.yaml", kind)
        assert checked.loaded is not None, checked.errors
        models[name] = checked.loaded.model
    connections = set()
    for name in names:
        relay = models[name]
        assert isinstance(relay, RelayFile) and relay.fabric is not None
        assert set(relay.fabric.relays or ()) == {*names} - {name} and relay.fabric.certificates == "fabric"
        connections |= {
            frozenset((name, other)) for other in names if f"tls/127.0.0.1:{between[other]}" in relay.fabric.peers
        }
    assert len(connections) == count * (count - 1) / 2, "every two have one"
    for name in CLIENTS:
        client = models[name]
        assert isinstance(client, ClientFile)
        order = [relay.endpoint for relay in client.all_relays]
        assert order == [f"tcp://127.0.0.1:{ports[relay]}" for relay in asked.order(name)] and len(order) == count
    assert asked.order("robot1")[0] == names[0] and asked.order("site")[0] == names[-1]


class Logs:
    """A run of 20 s with a message of each stream every 100 ms, and 10 ms on the way; those of robot1 stand still for
    the three seconds after the kill. What is reliable comes then, the rest is lost."""

    def __init__(self) -> None:
        self.logs: dict[str, TopicLog] = {}
        for stream in streams():
            log = self.logs[stream.topic] = TopicLog(stream.topic, "state", stream.source)
            for seq in range(1, 10 * END_S):
                at_ns = ORIGIN_NS + seq * S // 10
                log.offers[seq] = Offer(at_ns, seq, 100, seq)
                gone = "robot1" in stream.topic and KILL_S <= seq / 10 < KILL_S + 3
                if gone and not stream.reliable:
                    continue
                arrives_ns = RUN.kill_ns + 3 * S if gone else at_ns
                log.deliveries.append(Delivery(arrives_ns + S // 100, seq, 100, seq, at_ns, None))

    def judged(self, run: Run = RUN) -> RelaysReport:
        return judged("sern demo --relays 3", "now", run, streams(), self.logs)


def broken(report: RelaysReport) -> set[str]:
    return {verdict.name for verdict in report.verdicts if not verdict.ok}


def test_a_good_run_keeps_every_promise() -> None:
    report = Logs().judged()
    assert broken(report) == set() and report.ok
    rows = {row.stream.topic: row for row in report.rows}
    assert rows[LOG].gap_s == pytest.approx(3.01) and rows["/robot2/log"].gap_s == pytest.approx(0.01)
    assert rows[COMMAND].gap_s == pytest.approx(3.01)
    assert (rows[LOG].lost, rows[POSE].lost, rows["/robot2/points"].lost) == (0, 30, 0)
    assert rows[LOG].before_s == rows[POSE].after_s == pytest.approx(0.01)
    assert rows[COMMAND].oldest_s == pytest.approx(0.01) and rows[LOG].oldest_s == pytest.approx(3.01)
    assert {verdict.name for verdict in report.verdicts} == {
        "reliable_faults", "corrupted_messages", "expired_commands", "longest_gap_s", "clients_astray",
    }  # fmt: skip


def lose(logs: Mapping[str, TopicLog]) -> None:
    logs[LOG].deliveries = [each for each in logs[LOG].deliveries if each.seq != 105]


def double(logs: Mapping[str, TopicLog]) -> None:
    logs[LOG].deliveries.append(logs[LOG].deliveries[99])


def disorder(logs: Mapping[str, TopicLog]) -> None:
    deliveries = logs[LOG].deliveries
    deliveries[50], deliveries[51] = deliveries[51], deliveries[50]


def alter(logs: Mapping[str, TopicLog]) -> None:
    logs[POSE].deliveries[5] = logs[POSE].deliveries[5]._replace(crc32=0)


def delay_a_command(logs: Mapping[str, TopicLog]) -> None:
    deliveries = logs[COMMAND].deliveries
    deliveries[3] = deliveries[3]._replace(wall_ns=deliveries[3].stamp_ns + S)


def silence(logs: Mapping[str, TopicLog]) -> None:
    logs[POSE].deliveries = [each for each in logs[POSE].deliveries if each.stamp_ns < RUN.kill_ns]


@pytest.mark.parametrize(
    ("spoil", "promise"),
    [
        (lose, "reliable_faults"),
        (double, "reliable_faults"),
        (disorder, "reliable_faults"),
        (alter, "corrupted_messages"),
        (delay_a_command, "expired_commands"),
        (silence, "longest_gap_s"),
    ],
)
def test_a_promise_that_is_broken(spoil, promise: str) -> None:  # type: ignore[no-untyped-def]
    logs = Logs()
    spoil(logs.logs)
    report = logs.judged()
    assert broken(report) == {promise} and not report.ok


@pytest.mark.parametrize(
    "after",
    [
        {"robot1": "relay1", "robot2": "relay2", "site": "relay3"},
        {"robot1": None, "robot2": "relay2", "site": "relay3"},
        {"robot1": "relay3", "robot2": "relay3", "site": "relay3"},
    ],
)
def test_a_client_that_is_elsewhere(after: dict[str, str | None]) -> None:
    assert broken(Logs().judged(replace(RUN, after=after))) == {"clients_astray"}


def test_what_was_under_way_before_and_after_the_run_is_left_out() -> None:
    logs = Logs()
    for seq, at_s in ((1000, -1.0), (1001, END_S + 1.0)):
        logs.logs[POSE].offers[seq] = Offer(ORIGIN_NS + int(at_s * S), seq, 100, seq)
    logs.logs[LOG].offers[2000] = Offer(ORIGIN_NS - S, 2000, 100, 2000)
    rows = {row.stream.topic: row for row in logs.judged().rows}
    assert (rows[POSE].sent, rows[POSE].lost, rows[LOG].lost) == (199, 30, 0)


def test_a_run_without_any_message_is_broken_and_still_shown(capsys: pytest.CaptureFixture[str]) -> None:
    report = judged("", "", RUN, streams(), {})
    assert broken(report) >= {"reliable_faults", "expired_commands", "longest_gap_s"}
    show(report, Console(width=80))
    assert "never" in capsys.readouterr().out
    assert json.loads(as_json(report))["rows"][0]["gap_s"] is None


@pytest.mark.parametrize("width", [80, 120])
def test_what_is_shown_fits(width: int, capsys: pytest.CaptureFixture[str]) -> None:
    show(Logs().judged(), Console(width=width))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= width and "…" not in text
    for words in ("What it cost that relay1 was killed", "log of robot1 *", "3.01 s", "relay1  relay2", "stayed"):
        assert words in text
    assert "The oldest of the commands to robot1: 10.0 ms, of 300.0 ms allowed." in text


def test_its_figures() -> None:
    figures = json.loads(as_json(Logs().judged()))
    rows = {row["case"]: row for row in figures["rows"]}
    assert rows[LOG]["reliable"] and rows[LOG]["lost_messages"] == 0 and math.isclose(rows[LOG]["gap_s"], 3.01)
    assert rows["robot1"] == {"case": "robot1", "relay_before": "relay1", "relay_after": "relay2", "moved_s": 2.4}
    assert all(entry["ok"] for entry in figures["reach"]) and figures["killed"] == "relay1"


# Real processes -------------------------------------------------------------------------------------------------------


async def test_a_short_run_leaves_its_figures_and_nothing_else(tmp_path: Path) -> None:
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    demo = Started(tmp_path)
    try:
        await demo.start("--relays", "3", "--duration", "8", "--out", "result", own_profiles=False)
        status = await demo.ended()
        assert status in (EXIT_OK, EXIT_BROKEN), demo.output
        demo.assert_nothing_left()
    finally:
        await demo.clean_up()
    assert "Traceback" not in demo.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["result", "tmp"]
    figures = json.loads((tmp_path / "result" / "result.json").read_text())
    found = {entry["name"]: entry["ok"] for entry in figures["reach"]}
    assert {name: found[name] for name in INDEPENDENT_OF_SPEED} == dict.fromkeys(INDEPENDENT_OF_SPEED, True), (
        demo.output
    )
    assert status == (EXIT_OK if all(found.values()) else EXIT_BROKEN)
    rows = {row["case"]: row for row in figures["rows"]}
    assert rows["robot1"]["relay_before"] == "relay1" and rows["site"]["relay_before"] == "relay3"
    for words in ("1/3  3 relays", "3/3  relay1 is killed", "What it cost that relay1 was killed"):
        assert words in demo.output


async def test_ctrl_c_stops_every_process(tmp_path: Path) -> None:
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    demo = Started(tmp_path)
    try:
        await demo.start("--relays", "2", own_profiles=False)
        process = await demo.reaches("1/3", processes=3)
        process.send_signal(signal.SIGINT)
        assert await demo.ended() == EXIT_INTERRUPTED, demo.output
        demo.assert_nothing_left()
    finally:
        await demo.clean_up()
    assert not (tmp_path / "demo-out").exists() and "Traceback" not in demo.output


def test_without_zenoh_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(typer.Exit) as ended:
        demo(relays=3)
    assert ended.value.exit_code == EXIT_ERROR
    command = f"{sys.executable} -m pip install eclipse-zenoh"
    assert capsys.readouterr().err == f"sern demo: --relays needs zenoh: {command}\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"bag": Path("run.bag")}, "--bag does not go with --relays; leave one of them out"),
        ({"duration": 4.0}, "--relays needs 8 s: a client leaves a relay that is silent for 2 s, not before"),
    ],
)
def test_what_does_not_go_together_is_one_line(
    arguments: dict[str, Path | float], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("zenoh", reason="zenoh is not installed: pip install 'sern[zenoh]'")
    with pytest.raises(typer.Exit) as ended:
        demo(relays=2, **arguments)  # type: ignore[arg-type]
    assert ended.value.exit_code == EXIT_ERROR
    assert capsys.readouterr().err == f"sern demo: {words}\n"
