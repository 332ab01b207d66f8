"""What an operator changes while daemons run: `sern set` on the local socket, and SIGHUP with another file."""

import asyncio
import json
import signal
import stat
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import pytest
from typer.testing import CliRunner

from sern_core.vocabulary.errors import SernError, UsageError
from sern_runtime.local_socket import ask
from sern_tools.commands import app
from tests.daemons import Lab, Process, bodies
from tests.notified import notified
from tests.support import until

SCAN: Final = {"match": "/(.+/)?scan", "class": "state", "direction": "send"}
COUNTER: Final = {"match": "/count[12]", "class": "bulk", "reliability": "reliable"}
ROBOT: Final = {"kind": "synthetic", "role": "robot", "topics": ["/pose"], "counter_topics": ["/count1", "/count2"]}


@pytest.fixture
def socket_path() -> Iterator[Path]:
    """Short: a socket's name has at most 107 bytes."""
    with TemporaryDirectory(prefix="sern-", dir="/tmp") as directory:
        yield Path(directory) / "robot1.sock"


def robot_file(lab: Lab, socket_path: Path, rules: list[dict[str, Any]], **sections: Any) -> Path:
    local = {"socket": str(socket_path)}
    return lab.client_file("robot1", ROBOT, topics=rules, local=local, **sections)


async def say(*words: str) -> tuple[int, str, str]:
    """Run the `sern` command; its exit code, standard output and standard error."""
    result = await asyncio.to_thread(CliRunner().invoke, app, words)
    return result.exit_code, result.stdout, result.stderr


def counts(path: Path) -> dict[str, list[int]]:
    """The numbers of the counter topics of a recording, in their order."""
    found = {}
    for name, texts in bodies(path).items():
        if "/count" in name:
            found[name] = [int(text.rstrip(b"\0").split()[-1]) for text in texts]
    return found


def announced_class(robot: Process, topic: str) -> str:
    return str(robot.json("/api/topics")[topic]["class"])


async def test_a_topic_is_set_by_hand_while_it_runs_and_no_message_is_lost(tmp_path: Path, socket_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*", path="got")).ready()
        rules = [COUNTER, {"match": "/pose", "class": "control"}]
        robot = await lab.process(robot_file(lab, socket_path, rules)).ready()
        await until(socket_path.exists)
        assert stat.S_IMODE(socket_path.stat().st_mode) == 0o600
        await site.until(lambda: delivered_of(site, "/robot1/count1") > 5, "it counts")
        client = ["--client", str(socket_path)]
        assert await say("set", *client) == (0, "nothing is set by hand: all is as the file says\n", "")
        code, out, err = await say("set", "/count1", "class=state", "depth=50", *client)
        assert (code, err) == (0, "") and out.startswith("/count1  class=state depth=50")
        assert (await say("set", "/robot1/pose", "max_rate_hz=5", *client))[:2] == (0, "/pose  max_rate_hz=5\n")
        await robot.until(lambda: announced_class(robot, "/robot1/count1") == "state", "is offered as it was set")
        listed = (await say("set", *client))[1].splitlines()
        assert listed == ["/count1  class=state depth=50", "/pose  max_rate_hz=5"]
        assert "set by hand: /pose max_rate_hz=5" in (await say("top", "--once", "--api", api(robot)))[1]
        await site.until(lambda: delivered_of(site, "/robot1/count1") > 15, "it counts on")
        assert (await say("set", "/count1", "--reset", *client))[0] == 0
        await robot.until(lambda: announced_class(robot, "/robot1/count1") == "bulk", "is as its file says again")
        await site.until(lambda: delivered_of(site, "/robot1/count1") > 25, "and on")
        events = [event["text"] for event in robot.json("/api/events")["events"] if event["kind"] == "set"]
        assert events[0] == "/count1: set by hand: class=state depth=50" and len(events) == 3
        await robot.stop()
        await site.stop()
        await relay.stop()
        assert not socket_path.exists(), "it goes with its daemon"
    for name, numbers in counts(tmp_path / "got.bag").items():
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), f"{name} has gaps or comes twice"


def delivered_of(site: Process, topic: str) -> int:
    row = site.json("/api/topics").get(topic, {})
    return int(row.get("received", row).get("delivered", 0))


def api(process: Process) -> str:
    return f"http://127.0.0.1:{process.port}"


async def test_a_wrong_request_is_one_line_that_says_what_to_do(tmp_path: Path, socket_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        robot = lab.process(robot_file(lab, socket_path, [COUNTER]))  # there is no relay, and none is needed
        await robot.said("the local socket is ")
        for words, said in (
            (["/count1", "speed=2"], "'speed' cannot be set while it runs; accepted: class, weight, "),
            (["/count1", "depth=many"], "/count1: depth: expected "),
            (["/count1", "depth"], "'depth' is not key=value, such as max_rate_hz=2"),
            (["/count1", "class=urgent"], "'urgent' is not accepted; accepted: control, state, bulk"),
            (["/count9", "depth=2"], "/count9 is no topic here; `sern topics` lists those there are"),
            (["count1", "depth=2"], "topic 'count1' must start with '/'"),
            (["/count2", "--reset"], "nothing of /count2 is set by hand"),
            (["--profile", "mapping"], "the file has no section adaptation"),
            (["/count1"], "say what to set, such as: sern set /count1 max_rate_hz=2"),
        ):
            code, out, err = await say("set", *words, "--client", str(socket_path))
            assert (code, out) == (2, "") and err.count("\n") == 1 and err.startswith("sern set: "), err
            assert said in err, err
        assert ask(socket_path, {"do": "list"})["topics"] == {}, "nothing of it was taken"
        with pytest.raises(UsageError, match="'dance' is nothing that this client does"):
            ask(socket_path, {"do": "dance"})
        await robot.stop()
    code, _out, err = await say("set", "--client", str(socket_path))
    assert code == 1 and "no daemon is there; start the client" in err and err.count("\n") == 1
    code, _out, err = await say("set", "--client", "nobody")
    assert code == 1 and "no client nobody has a local socket here" in err and err.count("\n") == 1


async def test_a_reload_takes_topics_and_keeps_what_is_set_by_hand(tmp_path: Path, socket_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*", path="got")).ready()
        manual: dict[str, Any] = {"discovery": {"mode": "manual"}}
        config = robot_file(lab, socket_path, [COUNTER], **manual)
        robot = await lab.process(config).ready()
        await site.until(lambda: delivered_of(site, "/robot1/count2") > 5, "it counts")
        ask(socket_path, {"do": "set", "topic": "/count1", "words": ["weight=5", "depth=20"]})
        before = json.loads(config.read_text())
        assert "/robot1/pose" not in robot.json("/api/topics")

        def reload(**changes: Any) -> None:
            config.write_text(json.dumps({**before, **changes}))
            robot.signal(signal.SIGHUP)

        # Other rules: a topic comes, one key of what is set by hand is the file's again.
        reload(topics=[{**COUNTER, "depth": 30}, {"match": "/pose", "class": "control"}], log={"level": "debug"})
        await robot.said("reloaded topics, subscriptions, discovery and adaptation; log changed and need a restart")
        await robot.said("no more set by hand, as the file says otherwise: /count1 depth")
        await robot.until(lambda: "/robot1/pose" in robot.json("/api/topics"), "offers what it did not")
        assert ask(socket_path, {"do": "list"})["topics"] == {"/count1": {"weight": 5}}
        # A file that is wrong changes nothing, and is said for as long as it is.
        reload(topics=[{"match": "/pose", "class": "urgent"}])
        await robot.said("reload failed, the old configuration stays: ", "robot1.yaml:", "topics.0.class: 'urgent'")
        assert "/robot1/pose" in robot.json("/api/topics")
        assert "sern_client_reload_failed 1.0" in robot.get("/metrics")[1]
        reload()
        await robot.said("the reload works again: what the file says is in force, after ")
        await robot.until(lambda: announced_class_gone(robot, "/robot1/pose"), "offers it no more")
        assert "sern_client_reload_failed 0.0" in robot.get("/metrics")[1]
        await site.until(lambda: delivered_of(site, "/robot1/count2") > 25, "it counts on")
        await robot.stop()
        await site.stop()
        await relay.stop()
    for name, numbers in counts(tmp_path / "got.bag").items():
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), f"{name} has gaps or comes twice"


def announced_class_gone(robot: Process, topic: str) -> bool:
    row = robot.json("/api/topics").get(topic)
    return row is None or not row.get("announced", False)


async def test_a_site_subscribes_otherwise_after_a_reload(tmp_path: Path, socket_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay()
        robot = await lab.connected(robot_file(lab, socket_path, [COUNTER]))
        config = lab.recorder_file("site", "/robot1/count1", path="got")
        site = await lab.connected(config)
        streams = site.bridge.inbound.streams
        await until(lambda: [stream.topic for stream in streams] == ["/robot1/count1"])
        content = json.loads(config.read_text())
        config.write_text(json.dumps({**content, "subscribe": ["/robot1/count2"]}))
        site.reload()
        await until(lambda: [stream.topic for stream in streams if site.core.subscription.patterns] and
                    "/robot1/count2" in {stream.topic for stream in streams})  # fmt: skip
        assert site.operating.reloads.failures == 0
        for daemon in (site, robot, relay):
            await lab.end(daemon)


async def test_systemd_is_told_of_a_reload_of_a_client(tmp_path: Path, socket_path: Path) -> None:
    with notified() as systemd:
        async with Lab(tmp_path, "robot1") as lab:
            config = robot_file(lab, socket_path, [COUNTER])
            robot = systemd.process(lab, config)
            await until(lambda: systemd.says("READY=1"))
            config.write_text(json.dumps({"client": 1}))
            robot.signal(signal.SIGHUP)
            await until(lambda: systemd.says("; reload failed, the old configuration stays: "))
            await robot.stop()
    told = systemd.told
    begins = next(at for at, text in enumerate(told) if text.startswith("RELOADING=1\nMONOTONIC_USEC="))
    ends = next(at for at, text in enumerate(told) if at > begins and text.startswith("READY=1"))
    assert "STATUS=link " in told[ends]


async def test_who_may_not_is_told_so(socket_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may always: the kernel's refusal is played."""
    import socket

    def refused(_self: object, _address: object) -> None:
        raise PermissionError

    class Refusing(socket.socket):
        connect = refused

    monkeypatch.setattr("sern_runtime.local_socket.socket.socket", Refusing)
    with pytest.raises(SernError, match="not yours to speak to; run this as the daemon's user, or with sudo"):
        ask(socket_path, {"do": "list"})
