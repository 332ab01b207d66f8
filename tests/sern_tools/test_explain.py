"""`sern explain`: a recording over a scripted link, and a running daemon, read by a person."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sern_tools.commands import app
from sern_tools.explain import WIDTH
from sern_tools.explain_replay import Setup, read_bag
from tests.daemons import Lab, write_bag
from tests.support import until

RUNNER = CliRunner()


def sparse_bag(path: Path) -> Path:
    """Texts on three topics, one a millisecond: half a megabit a second for some seconds."""
    return write_bag(path, {"/chat": 8000, "/log": 4000, "/note": 2000})


def explain(*words: str, code: int = 0) -> str:
    result = RUNNER.invoke(app, ["explain", *words])
    assert result.exit_code == code, result.output
    return result.output


def test_a_recording_is_explained_interval_by_interval(tmp_path: Path) -> None:
    bag = sparse_bag(tmp_path / "run.bag")
    text = explain("--bag", str(bag), "--link", "mesh-radio", "--duration", "7", "--every", "--details", "2")
    lines = text.splitlines()
    assert max(map(len, lines)) <= WIDTH
    assert lines[0].startswith("cost J = 0.45 latency + 0.3 unreliability")
    intervals = [float(line.split()[0]) for line in lines if re.match(r" +\d+\.\d +(unknown|\S+ [kM]?bit/s) ", line)]
    assert intervals == pytest.approx(range(9))
    assert text.count("  weighed   ") == 2
    assert "      ->   " in text and "  chosen    " in text and "  came to   " in text
    assert "/chat\n    message" in text and "offered" in text
    assert "/_sern/" not in text


def test_json_has_every_term_of_every_interval(tmp_path: Path) -> None:
    bag = sparse_bag(tmp_path / "run.bag")
    told = json.loads(explain("--bag", str(bag), "--link", "field-wifi", "--duration", "5", "--json"))
    assert [step["at_s"] for step in told["steps"]] == pytest.approx(range(7), abs=0.01)
    measured = [step["measured"] for step in told["steps"] if step["measured"] is not None]
    assert measured and all(0.0 <= term <= 1.0 for part in measured for term in part["terms"].values())
    costs = [candidate["cost"] for candidate in told["steps"][-1]["candidates"] if not candidate["obstacle"]]
    assert len(costs) >= 2 and costs == sorted(costs)
    topics = told["topics"]["/chat"]
    settled = topics["delivered"] + sum(topics["dropped"].values())
    assert 0.9 * topics["offered"] < settled <= topics["offered"]


def test_the_story_of_one_topic(tmp_path: Path) -> None:
    bag = sparse_bag(tmp_path / "run.bag")
    section = {"policy": "fixed", "fixed": {"rates": {"control": 0.2, "state": 0.2, "bulk": 0.2}}}
    config = Lab(tmp_path, "robot1").client_file("robot1", {"kind": "synthetic", "role": "robot"}, adaptation=section)
    text = explain("--bag", str(bag), "--duration", "3", "/chat", "--config", str(config))
    lines = text.splitlines()
    assert lines[0] == "/chat" and "  so far    of 3001 offered " in text
    assert lines[-1].split()[2] == "3001"
    assert "waits: the adaptation lets " in lines[-1], "the newest sample waits for its turn"
    assert "topics: /chat" in explain("--bag", str(bag), "--duration", "3", "/none", code=2)


def test_a_clients_file_decides_rules_and_weights(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "robot1")
    rules = [{"match": "/chat", "class": "control"}, {"match": ".*", "class": "state"}]
    section = {"profile": "mapping", "interval_s": 0.5}
    endpoint = {"kind": "synthetic", "role": "robot"}
    config = lab.client_file("robot1", endpoint, topics=rules, adaptation=section)
    told = json.loads(
        explain("--bag", str(sparse_bag(tmp_path / "run.bag")), "--config", str(config), "--duration", "3", "--json")
    )
    assert told["weights"]["bandwidth"] == 0.45
    assert {part["class"] for step in told["steps"] for part in step["offered"]} == {"control", "state"}
    assert len(told["steps"]) == 9
    assert Setup.of(None).adaptation.profile == "teleoperation"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--bag", "/nowhere/run.bag"], "/nowhere/run.bag: no such file; give a .bag"),
        (["/data/run.bag"], "/data/run.bag is a recording; give it with --bag"),
        (["odom"], "topic 'odom' must start with '/'"),
        (["--api", "nonsense"], "--api 'nonsense' is not an address"),
    ],
)
def test_what_cannot_be_explained_is_one_line(words: list[str], said: str) -> None:
    text = explain(*words, code=2)
    assert text.startswith(f"sern explain: {said}") and text.count("\n") == 1


def test_a_damaged_recording_and_an_unknown_link_are_one_line(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.bag"
    damaged.write_bytes(b"#ROSBAG V2.0\nnothing")
    text = explain("--bag", str(damaged), code=2)
    assert "cannot be read" in text and text.count("\n") == 1
    text = explain("--bag", str(sparse_bag(tmp_path / "run.bag")), "--link", "moon", code=2)
    assert "moon" in text and text.count("\n") == 1


def test_read_bag_stops_at_the_duration(tmp_path: Path) -> None:
    infos, messages = read_bag(sparse_bag(tmp_path / "run.bag"), 1.0)
    assert set(infos) == {"/chat", "/log", "/note"}
    assert 0.9 < messages[-1].at_s <= 1.0


async def test_a_running_robot_is_explained(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        relay_api = f"http://127.0.0.1:{relay.port}"
        site = lab.client_file("site", {"kind": "record", "path": "site"}, client={"namespace": "/"}, subscribe=["/.*"])
        await lab.process(site).ready()
        endpoint = {"kind": "synthetic", "role": "robot", "topics": 3}
        robot = await lab.process(lab.client_file("robot1", endpoint, adaptation={"interval_s": 0.2})).ready()
        api = f"http://127.0.0.1:{robot.port}"

        def measured() -> bool:
            links = robot.json("/api/mmcf")["links"]
            return any(step["measured"] for link in links for step in link["history"])

        await until(measured, "an interval is measured")
        text = explain("--api", api)
        assert "Topics, and what became of the last message of each" in text
        assert "  chosen    " in text
        topic = next(iter(robot.json("/api/topics")))

        def arrived() -> bool:
            records = robot.json(f"/api/trace?topic={topic}")["records"]
            return any(record["topic"] == topic and record["event"] == "acked" for record in records)

        await until(arrived, "the relay has acknowledged a message of it")  # an interval is measured by what is offered
        text = explain(topic, "--api", api)
        assert text.startswith(f"{topic} of robot1, to relay: class ")
        assert "  now       " in text and "  so far    of " in text and "  the last messages, and how long ago:" in text
        assert "arrived at relay after " in text
        assert robot.json(f"/api/trace?topic={topic}")["steps"] is True
        told = explain("/robot1/nothing", "--api", api, code=1)
        assert told.startswith(f"sern explain: {api}: topic '/robot1/nothing' is not known here; known: /robot1/")
        assert told.count("\n") == 1
        told = explain(topic, "--api", relay_api)
        assert f"{topic} of robot1, received from robot1: class " in told and f"{topic} of robot1, to site: " in told
        assert "adapts no link" in explain("--api", api, "--peer", "nobody", code=2)
