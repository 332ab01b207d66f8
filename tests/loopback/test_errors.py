"""What goes wrong, as the user sees it: one line that says what, where and what to do; never a traceback."""

import re
import shutil
import signal
import socket
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import typer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import sern_client.cli
import sern_relay.cli
from sern_runtime import logs
from sern_runtime.transport_watch import CUT, ENDED
from tests.daemons import HOST, START_NS, Lab, Process, balance, delivered, write_bag
from tests.support import until

CONFIG_ERROR = 2
INTERRUPTED = 128 + signal.SIGINT
NO_BAG = {"kind": "bag", "path": "missing.bag"}
ROBOT = {"kind": "synthetic", "role": "robot", "topics": 1}


async def refusal(process: Process) -> str:
    """The one line with which a daemon refuses to start, without the log before it."""
    assert await process.ended() == CONFIG_ERROR, process.text
    assert "Traceback" not in process.text
    lines = [line for line in process.lines if not re.match(r"\d{4}-\d\d-\d\dT", line)]
    assert len(lines) == 1, process.text
    return lines[0]


def broken(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


def _with_damaged_key(lab: Lab) -> Path:
    broken(lab.directory / "relay.pub", 'public_key: "', 'public_key: "~~')
    return lab.client_file("robot1", ROBOT)


def _without_directory(lab: Lab) -> Path:
    shutil.rmtree(lab.clients_dir)
    return lab.relay_file()


def _empty(path: Path) -> Path:
    path.write_bytes(b"")
    return path


def _cut_off(path: Path) -> Path:
    whole = write_bag(path.with_name("whole.bag"), {"/chat": 2000})
    data = whole.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


def _dangling(path: Path) -> Path:
    path.symlink_to(path.with_name("nowhere") / "file")
    return path


CASES: dict[str, Any] = {
    "malformed YAML": (
        lambda lab: broken(lab.client_file("robot1", ROBOT), '"client": {', '"client": ['),
        r"sern-client: {dir}/robot1\.yaml:\d+: .+",
    ),
    "unknown key word": (
        lambda lab: lab.client_file("robot1", ROBOT, discovery={"mod": "dynamic"}),
        r"sern-client: {dir}/robot1\.yaml:\d+: discovery\.mod: unknown key \(did you mean mode\?\); accepted: .+",
    ),
    "missing key file": (
        lambda lab: lab.client_file("robot1", ROBOT, relay={"secret_key_file": "nobody.key"}),
        r"sern-client: {dir}/robot1\.yaml:\d+: relay\.secret_key_file: {dir}/nobody\.key: no such file",
    ),
    "a key file of somebody else": (
        lambda lab: lab.client_file("robot1", ROBOT, relay={"secret_key_file": "relay.key"}),
        r"sern-client: {dir}/robot1\.yaml:\d+: relay\.secret_key_file: {dir}/relay\.key is the key of relay, "
        r"and this is robot1; use the key of robot1",
    ),
    "a file that is no key": (
        lambda lab: lab.client_file("robot1", ROBOT, relay={"server_key_file": "robot1.yaml"}),
        r"sern-client: {dir}/robot1\.yaml:\d+: relay\.server_key_file: {dir}/robot1\.yaml.*: is not a SERN key file; "
        r"make one with sern keygen \(a public key is needed here\)",
    ),
    "a damaged key": (
        _with_damaged_key,
        r"sern-client: {dir}/robot1\.yaml:\d+: relay\.server_key_file: {dir}/relay\.pub:\d+: keys\.0\.public_key: "
        r"is not a CURVE key: 40 characters of Z85 text, in quotes",
    ),
    "a recording that is not there": (
        lambda lab: lab.client_file("robot1", NO_BAG),
        r"sern-client: {dir}/robot1\.yaml:\d+: endpoint\.path: {dir}/missing\.bag: no such file or directory",
    ),
    "a recording of nothing": (
        lambda lab: lab.client_file("robot1", {"kind": "bag", "path": str(_empty(lab.directory / "empty.bag"))}),
        r"sern-client: {dir}/empty\.bag: cannot be read: it is empty; try `rosbag reindex {dir}/empty\.bag` on a copy",
    ),
    "a recording cut off": (
        lambda lab: lab.client_file("robot1", {"kind": "bag", "path": str(_cut_off(lab.directory / "cut.bag"))}),
        r"sern-client: {dir}/cut\.bag: cannot be read: it is cut off.+; try `rosbag reindex {dir}/cut\.bag` on a copy",
    ),
    "a message log that is a directory": (
        lambda lab: lab.client_file("robot1", ROBOT, message_log="clients"),
        r"sern-client: {dir}/robot1\.yaml:\d+: message_log: {dir}/clients is a directory; a file is needed",
    ),
    "a message log that cannot be written": (
        lambda lab: lab.client_file("robot1", ROBOT, message_log=str(_dangling(lab.directory / "messages.csv"))),
        r"sern-client: {dir}/messages\.csv: cannot write the message log: No such file or directory",
    ),
    "a relay without clients' keys": (
        _without_directory,
        r"sern-relay: {dir}/relay\.yaml:\d+: relay\.clients_dir: {dir}/clients: no such directory",
    ),
    "a relay open to the network": (
        lambda lab: lab.relay_file(
            relay={"insecure": True, "listen": ["tcp://*:5555"], "clients_dir": None, "secret_key_file": None}
        ),
        r"sern-relay: {dir}/relay\.yaml:\d+: relay\.listen\.0: is open to the network, .+",
    ),
    "an address that is not ours": (
        lambda lab: lab.relay_file(relay={"listen": ["tcp://192.0.2.1:5555"]}),
        r"sern-relay: {dir}/relay\.yaml:\d+: relay\.listen: cannot listen on tcp://192\.0\.2\.1:5555: this machine has "
        r"no such interface or address; see `ip address`, or listen on tcp://0\.0\.0\.0:PORT",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_with_the_files_is_one_line_and_exit_2(
    tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "configure", lambda **_: None)  # the root logger is pytest's
    make, expected = CASES[case]
    config = make(Lab(tmp_path, "robot1"))
    command = sern_relay.cli.command if config.stem == "relay" else sern_client.cli.command
    with pytest.raises(typer.Exit) as end:
        command(config)
    assert end.value.exit_code == CONFIG_ERROR
    line = capsys.readouterr().err
    assert re.fullmatch(expected.replace("{dir}", re.escape(str(tmp_path))) + "\n", line), line


@pytest.mark.parametrize("place", ["relay", "relay http", "client http"])
async def test_a_port_in_use_is_named_with_the_line_that_asks_for_it(tmp_path: Path, place: str) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        with socket.create_server((HOST, 0)) as taken:
            port = taken.getsockname()[1]
            http = {"listen": f"{HOST}:{port}"}
            if place == "relay":
                process = lab.process(lab.relay_file(relay={"listen": [f"tcp://{HOST}:{port}"]}))
                what = rf"relay\.yaml:\d+: relay\.listen: cannot listen on tcp://{HOST}:{port}"
            elif place == "relay http":
                process = lab.process(lab.relay_file(http=http))
                what = rf"relay\.yaml:\d+: http\.listen: cannot listen on http://{HOST}:{port}"
            else:
                process = lab.process(lab.client_file("robot1", ROBOT, http=http))
                what = rf"robot1\.yaml:\d+: http\.listen: cannot listen on http://{HOST}:{port}"
            line = await refusal(process)
        wanted = rf"sern-\w+: {re.escape(str(tmp_path))}/{what}: the port is in use; stop the other process or .+"
        assert re.fullmatch(wanted, line), line


async def test_a_relay_that_is_not_there_is_reported_once_and_found_when_it_comes(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        robot = lab.process(lab.client_file("robot1", ROBOT))
        await robot.said("WARNING", f"{lab.endpoint}: the relay does not answer: connecting failed; trying again")
        status, reason = robot.get("/readyz")
        assert (status, reason) == (503, "the relay does not answer: connecting failed\n")
        relay = await lab.process(lab.relay_file()).ready()
        await robot.ready()
        await relay.said("INFO", "robot1 connected")
        told = [line for line in robot.lines if "WARNING" in line or "ERROR" in line]
        assert ["the link is there again" in line for line in told] == [False, True], robot.text


@pytest.mark.parametrize("mistake", ["stranger", "wrong relay key"])
async def test_keys_that_do_not_fit_are_explained_and_tried_again(tmp_path: Path, mistake: str) -> None:
    async with Lab(tmp_path, "other") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        config = lab.client_file("robot1", ROBOT)
        if mistake == "stranger":
            reason = "relay refused our key: it is not in the relay's directory, or has expired"
        else:
            shutil.copy(lab.clients_dir / "other.pub", lab.directory / "relay.pub")
            reason = ENDED
        robot = lab.process(config)
        await robot.said("WARNING", f"{lab.endpoint}: {reason}; trying again until it works")
        assert robot.get("/readyz") in ((503, f"{reason}\n"), (503, f"{CUT}\n"))
        if mistake == "stranger":
            await relay.said("WARNING", "refused a connection from 127.0.0.1: unknown key")
            relay.signal(signal.SIGHUP)  # the administrator has copied the key
        else:
            await relay.until(lambda: refused(relay, "handshake") >= 2, "has refused it twice")
            await robot.stop()
            await relay.stop()
            lab.make_relay_keys()
            relay = await lab.process(relay.config).ready()
            robot = lab.process(config)
        await robot.ready()
        # CUT: libzmq had closed the connection before it was looked at.
        told = [line for line in robot.lines if CUT not in line and "the link is there again" not in line]
        assert sum("WARNING" in line or "ERROR" in line for line in told) <= 1, robot.text


async def test_a_key_that_the_relay_knows_by_another_name_is_explained(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        known = lab.clients_dir / "robot1.pub"
        broken(known, "name: robot1", "name: robot2")
        await lab.relay()
        robot = await lab.client(lab.client_file("robot1", ROBOT))
        await until(lambda: robot.bridge.rejected_reason)
        why = "your key belongs to robot2, not to robot1"
        assert f"the relay refuses us (name): {why}" in caplog.messages
        assert robot.readiness() == (False, why)


def refused(relay: Process, reason: str) -> float:
    """The relay's count of refused connections for a reason."""
    for line in relay.get("/metrics")[1].splitlines():
        if line.startswith(f'sern_relay_connections_refused_total{{reason="{reason}"}}'):
            return float(line.split()[-1])
    raise AssertionError(f"no counter for {reason}")


def _unknown_type(path: Path) -> Path:
    """A rosbag2 folder without definitions, as older versions wrote them: a type of the user's own, and a known one."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("int32 number\n", "odd_msgs/msg/Odd"))
    with Writer2(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        odd = writer.add_connection("/odd", "odd_msgs/msg/Odd", typestore=store)
        chat = writer.add_connection("/chat", "std_msgs/msg/String", typestore=store)
        for number in range(5):
            at_ns = START_NS + number * 1_000_000
            body = store.serialize_cdr(store.types["odd_msgs/msg/Odd"](number=number), "odd_msgs/msg/Odd")
            writer.write(odd, at_ns, body)
            text = store.types["std_msgs/msg/String"](data=f"{number}")
            writer.write(chat, at_ns, store.serialize_cdr(text, "std_msgs/msg/String"))
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        database.execute("DELETE FROM message_definitions")
        database.commit()
    return path


async def test_a_topic_that_cannot_be_recorded_is_named_and_the_others_go_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.relay()
        site = await lab.connected(lab.recorder_file("site", "/.*"))
        bag = _unknown_type(tmp_path / "odd")
        await lab.client(lab.player_file("robot1", bag, play={"wait_for": ["/chat"]}))
        await until(lambda: sum(c.delivered for c in site.core.received.topics.values()) == 5)
        wanted = (
            f"/robot1/odd from robot1 is not received: {tmp_path}/site: /robot1/odd: "
            "no definition of odd_msgs/msg/Odd is known, so no bag can hold it"
        )
        assert wanted in caplog.messages
    assert "Traceback" not in caplog.text


async def test_ctrl_c_during_connecting_and_during_replay_ends_cleanly(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 3000, "/log": 3000})
    async with Lab(tmp_path, "robot1", "site") as lab:
        robot = lab.process(lab.player_file("robot1", bag))
        await robot.said("connecting failed")
        robot.signal(signal.SIGINT)
        assert await robot.ended() == 0, robot.text
        relay = await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*")).ready()
        robot = lab.process(lab.player_file("robot1", bag, play={"loop": True}))
        await site.until(lambda: delivered(site) > 200, "has something")
        robot.signal(signal.SIGINT)
        assert await robot.ended() == 0, robot.text
        assert balance(robot.summary()["topics"]) == []
        site.signal(signal.SIGINT)
        assert await site.ended() == 0, site.text
        relay.signal(signal.SIGINT)
        assert await relay.ended() == 0, relay.text
        for process in (robot, site, relay):
            assert "Traceback" not in process.text, process.text


async def test_ctrl_c_twice_ends_at_once(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag", {"/chat": 3000})
    async with Lab(tmp_path, "robot1", "site") as lab:
        await lab.process(lab.relay_file()).ready()
        site = await lab.process(lab.recorder_file("site", "/.*")).ready()
        robot = lab.process(lab.player_file("robot1", bag, play={"loop": True}))
        await site.until(lambda: delivered(site) > 200, "has something")
        site.signal(signal.SIGSTOP)  # it confirms nothing more, so the robot waits for it before it ends
        robot.signal(signal.SIGINT)
        await robot.said("SIGINT: stopping")
        robot.signal(signal.SIGINT)
        assert await robot.ended() == INTERRUPTED
        assert "SIGINT again: ending at once" in robot.text
        assert "Traceback" not in robot.text
        site.signal(signal.SIGCONT)
