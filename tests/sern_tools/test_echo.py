"""`sern echo`: messages as text, who it is to the relay, and what it prints, refuses and leaves at a real one."""

import base64
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML
from typer.testing import CliRunner

from sern_core.link.handshake import NEW_SESSION
from sern_core.vocabulary.errors import ConfigError, RefusedError, SernError, UsageError
from sern_core.vocabulary.message import Message, StreamId, StreamInfo, TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, DropReason, Encoding, TopicName
from sern_runtime import ros_types
from sern_runtime.loop import Shutdown
from sern_runtime.transport_watch import CUT, ENDED, LOST, NOBODY
from sern_tools import echo
from sern_tools.commands import app
from sern_tools.echo import (
    Listener,
    Printer,
    RatePrinter,
    identity_from_file,
    identity_from_options,
    listen,
    poll,
)
from sern_tools.echo_text import Decoder, hex_text, scalar, text_of
from sern_tools.ports import free_ports
from tests.daemons import Lab, write_bag
from tests.support import DEADLINE_S, child, until

TEXT = "std_msgs/msg/String"
ROS1 = Encoding.ROS1
SAY = {"plain": Decoder(raw=False, full=False), "raw": Decoder(raw=True, full=False)}


def message_of(type_name: str, encoding: Encoding = ROS1, /, **values: Any) -> Any:
    return ros_types.new(type_name, encoding, **values)


def read_yaml(text: str) -> Any:
    return YAML(typ="safe").load(text)


# --- text -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", [Encoding.ROS1, Encoding.CDR])
def test_a_nested_message_is_yaml(encoding: Encoding) -> None:
    odom = message_of("nav_msgs/msg/Odometry", encoding, child_frame_id="base")
    odom.pose.pose.position.x = 1.5
    text = text_of(odom)
    assert "\n  pose:\n    position:\n      x: 1.5\n" in text
    read = read_yaml(text)
    assert read["child_frame_id"] == "base"
    assert read["twist"]["covariance"] == [0.0] * 36 or read["twist"]["covariance"][-1] == "..."
    assert "__msgtype__" not in text


def test_lists_of_messages_and_long_arrays() -> None:
    transforms = [message_of("geometry_msgs/msg/TransformStamped", child_frame_id=f"f{number}") for number in range(3)]
    message = message_of("tf2_msgs/msg/TFMessage", transforms=transforms)
    assert [item["child_frame_id"] for item in read_yaml(text_of(message))["transforms"]] == ["f0", "f1", "f2"]
    assert text_of(message, max_items=1).endswith("\n# 2 more")
    scan = message_of("sensor_msgs/msg/LaserScan", ranges=np.arange(40, dtype=np.float32))
    assert "ranges: [0.0, 1.0, ...]  # 40 in all\n" in text_of(scan, max_items=2)
    assert read_yaml(text_of(scan, max_items=None))["ranges"] == list(range(40))
    assert "intensities: []" in text_of(scan)
    assert text_of(message_of("std_msgs/msg/Empty")) == "{}"


@given(st.text())
def test_text_from_elsewhere_cannot_steer_the_terminal(text: str) -> None:
    shown = scalar(text)
    assert shown.isprintable()
    assert "\n" not in shown
    if not any(0xD800 <= ord(character) < 0xE000 for character in text):  # no text, and not YAML
        assert read_yaml(shown) == text


@given(st.floats() | st.booleans() | st.integers())
def test_numbers_read_back(value: float) -> None:
    read = read_yaml(scalar(value))
    assert type(read) is type(value)
    assert read == value or (read != read and value != value)


def test_raw_bytes_are_cut() -> None:
    assert hex_text(bytes(range(40))).splitlines()[1] == "20212223 24252627"
    assert hex_text(bytes(300)).endswith("\n# 44 more bytes")
    assert "more" not in hex_text(bytes(300), max_bytes=None)


def test_what_cannot_be_decoded_is_one_line() -> None:
    plain, raw = SAY["plain"], SAY["raw"]
    for type_name, definition, encoding, words in (
        ("", "", Encoding.RAW, "without a ROS type; --raw"),
        ("my_msgs/msg/Thing", "", ROS1, "type my_msgs/msg/Thing is unknown here, and no definition came"),
        ("nonsense", "", ROS1, "'nonsense' is not a message type"),
        ("my_msgs/msg/Odd", "???", ROS1, "cannot be parsed"),
    ):
        with pytest.raises(SernError, match=words) as caught:
            plain.prepare("/a", type_name, definition, encoding)
        assert "\n" not in str(caught.value)
        raw.prepare("/a", type_name, definition, encoding)
    with pytest.raises(SernError, match=r"/a cannot be decoded: .*--raw prints the bytes"):
        plain.text("/a", TEXT, ROS1, b"\xff")
    assert raw.text("/a", TEXT, ROS1, b"\xff") == "ff"
    plain.prepare("/a", "my_msgs/msg/Partial", "my_msgs/Absent part", ROS1)
    with pytest.raises(SernError, match=r"/a cannot be decoded: .*Absent"):
        plain.text("/a", "my_msgs/msg/Partial", ROS1, bytes(8))


def test_a_definition_that_came_with_the_topic_is_enough() -> None:
    decoder = Decoder(raw=False, full=False)
    decoder.prepare("/a", "sern_echo_test/msg/Count", "uint32 count\n", ROS1)
    assert decoder.text("/a", "sern_echo_test/msg/Count", ROS1, b"\7\0\0\0") == "count: 7"


# --- what is printed --------------------------------------------------------------------------------------------------


def stream_of(topic: str = "/r/text", type_name: str = TEXT) -> StreamInfo:
    info = TopicInfo(TopicName(topic), type_name, ROS1)
    return StreamInfo(StreamId(ClientName("r"), 1, info.name), info, TopicSpec())


def text_message(stream: StreamInfo, seq: int, text: str = "x", *, replay: bool = False) -> Message:
    body = ros_types.serialise(message_of(TEXT, data=text), TEXT, ROS1)
    return Message(stream.id, seq, body, 0, 0.0, replay=replay)


def test_printed_messages_are_yaml_documents() -> None:
    out, stream = StringIO(), stream_of()
    printer = Printer(SAY["plain"], out, count=2)
    printer.opened(stream)
    assert not printer.show(stream, text_message(stream, 1, "one", replay=True), 0.25)
    printer.lost(stream, 1, "retention")
    assert printer.show(stream, text_message(stream, 3, "three"), 0.5)
    assert out.getvalue() == (
        '# r seq 1 age 0.250 s replay\ndata: "one"\n---\n'
        "# r: 1 reliable message(s) will not come: retention\n---\n"
        '# r seq 3 age 0.500 s\ndata: "three"\n---\n'
    )


def test_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("sern_tools.echo.clock.now", lambda: now_s)
    out, stream = StringIO(), stream_of()
    printer = RatePrinter(out, count=2)
    printer.opened(stream)
    for seq, age_s in ((1, 0.1), (2, 0.3), (5, 0.2)):
        printer.show(stream, text_message(stream, seq), age_s)
    assert not printer.tick()
    now_s = 102.0
    assert not printer.tick()
    now_s = 103.0
    assert printer.tick()
    first, second = out.getvalue().splitlines()
    assert " ".join(first.split()) == "1.5 Hz 0.0 kB/s age p50 0.200 max 0.300 s not here 2 (in all 3, 2)"
    assert "no messages" in second
    assert second.endswith("not here 0 (in all 3, 2)".replace("0 (", "0  ("))


async def test_a_rival_with_our_name_is_seen() -> None:
    said: list[str] = []
    listener = Listener(Printer(SAY["plain"], StringIO(), count=None), said.append)
    listener.link_up(resumed=False)
    listener.link_down("connection lost")
    listener.link_up(resumed=True)
    assert said == ["link down: connection lost; waiting", "connected again"]
    assert listener.turns == 0
    for _ in range(3):
        listener.link_down(NEW_SESSION)
    assert listener.turns == 3


async def test_what_a_listener_is_told() -> None:
    said: list[str] = []
    out, stream = StringIO(), stream_of()
    listener = Listener(Printer(SAY["plain"], out, count=None), said.append)
    listener.stream_opened(stream)
    listener.expired(stream, 4, DropReason.RETENTION)
    listener.skipped(stream, 2)
    listener.stream_closed(stream)
    assert listener.left.is_set()
    assert said == ["/r/text of r has ended"]
    assert out.getvalue().count("will not come") == 2
    with pytest.raises(ConfigError):
        listener.stream_opened(stream_of("/r/odd", "my_msgs/msg/Thing"))
    assert "my_msgs/msg/Thing is unknown" in str(listener.problem)
    listener.rejected("name", "your key belongs to r")
    assert str(listener.problem) == "the relay refuses us: your key belongs to r"
    listener.subscription_refused("forbidden", "r may not subscribe to /x")
    assert str(listener.problem) == "the relay refuses us: r may not subscribe to /x"


@pytest.mark.parametrize("told", ["expired", "skipped", "undecodable"])
async def test_a_listener_whose_reader_has_gone_is_done(told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """`sern echo ... | head`, and what comes next is no message."""

    class Gone(StringIO):
        def write(self, text: str, /) -> int:
            raise BrokenPipeError

    left: list[str] = []
    monkeypatch.setattr(echo, "drop_output", lambda: left.append("output"))
    stream = stream_of()
    listener = Listener(Printer(SAY["plain"], Gone(), count=None), left.append)
    tell = {
        "expired": lambda: listener.expired(stream, 4, DropReason.RETENTION),
        "skipped": lambda: listener.skipped(stream, 2),
        "undecodable": lambda: listener.undecodable(stream, "damaged"),
    }
    tell[told]()
    assert listener.done and listener.problem is None and left == ["output"]


# --- who it is --------------------------------------------------------------------------------------------------------


def test_options_that_do_not_fit(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "viewer")
    key, relay_key = tmp_path / "viewer.key", tmp_path / "relay.pub"
    good = identity_from_options(lab.endpoint, key, relay_key, None)
    assert (good.name, good.endpoint, len(good.server_keys)) == ("viewer", lab.endpoint, 1)
    assert identity_from_options(lab.endpoint, None, None, "viewer").keys is None
    for arguments, words in (
        ((lab.endpoint, key, None, None), "give --key and --server-key"),
        ((lab.endpoint, None, None, None), "or --name alone"),
        ((lab.endpoint, key, relay_key, "viewer"), "or --name alone"),
        (("tcp://relay.example:5555", None, None, "viewer"), "only for ipc:// and loopback"),
        (("relay.example", key, relay_key, None), "--relay relay.example: .* is not an endpoint"),
    ):
        with pytest.raises(UsageError, match=words):
            identity_from_options(*arguments)
    with pytest.raises(ConfigError, match="is a public key file"):
        identity_from_options(lab.endpoint, relay_key, relay_key, None)


def test_a_client_file_is_enough(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    path = lab.client_file("viewer", {"kind": "bag", "path": "there-is-none.bag"})
    identity = identity_from_file(path)
    assert (identity.name, identity.endpoint) == ("viewer", lab.endpoint)
    assert identity.http == json.loads(path.read_text())["http"]["listen"]


def test_exit_codes(tmp_path: Path) -> None:
    runner = CliRunner()
    for arguments, code, words in (
        (["/a", "--api", "http://127.0.0.1:1", "--relay", "tcp://127.0.0.1:1"], 2, "give one place to listen at"),
        (["/a", "--rate"], 2, "--rate needs every message"),
        (["/a", "--key", "x.key"], 2, "go with --relay"),
        (["a", "--api", "http://127.0.0.1:1"], 2, "topic 'a' must start with '/'"),
        (["/a", "--api", "http://127.0.0.1:1", "--rate"], 2, "--rate needs every message"),
        (["/a", "--api", "http://127.0.0.1:1", "--name", "x"], 2, "go with --relay"),
        (["/a", "--config", str(tmp_path / "none.yaml")], 2, "no such file"),
        (["/a", "--api", "http://127.0.0.1:1"], 1, "is the daemon running"),
    ):
        result = runner.invoke(app, ["echo", *arguments])
        assert (result.exit_code, result.stderr.count("\n")) == (code, 1), result.output
        assert words in result.stderr


# --- against real daemons -----------------------------------------------------------------------------------------

ACCESS = (
    {"client": "robot1", "publish": ["/{self}/.*"]},
    {"client": "viewer", "subscribe": ["/robot1/(text|hidden)"]},
)


class Show:
    """One run of `sern echo` in this process."""

    def __init__(self, lab: Lab, name: str = "viewer") -> None:
        self.out = StringIO()
        self.said: list[str] = []
        self.shutdown = Shutdown()
        server = lab.directory / "relay.pub"
        self.identity = identity_from_options(lab.endpoint, lab.directory / f"{name}.key", server, None)

    async def run(self, topic: str = "/robot1/text", *, count: int | None = None, timeout_s: float = 0.0) -> str:
        printer = Printer(SAY["plain"], self.out, count=count)
        await listen(
            TopicName(topic), self.identity, printer, self.shutdown, timeout_s=timeout_s, warn=self.said.append
        )
        return self.out.getvalue()


async def start(lab: Lab, make_bag: Callable[[Path], Path]) -> Any:
    relay = await lab.relay(lab.relay_file(access=list(ACCESS)))
    await lab.connected(lab.player_file("robot1", make_bag(lab.directory / "a.bag")))
    return relay


def three_texts(path: Path) -> Path:
    return write_bag(path, {"/text": 3, "/secret": 3})


async def test_it_prints_what_a_site_would_get_and_leaves_nothing(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "viewer") as lab:
        bag = three_texts(tmp_path / "a.bag")
        relay = await lab.relay(lab.relay_file(access=list(ACCESS)))
        await lab.connected(lab.player_file("robot1", bag, play={"wait_for": ["/text"]}))
        show = Show(lab)
        text = await show.run(count=3)
        documents = [read_yaml(part) for part in text.split("---\n") if part]
        assert [document["data"] for document in documents] == ["/text 1", "/text 2", "/text 3"]
        assert text.startswith("# robot1 seq 1 age ")
        assert show.said == []
        # Nothing is kept for it, and no publisher waits for it.
        await until(lambda: ClientName("viewer") not in relay.hub.links, "it is forgotten")


async def test_a_topic_that_may_not_be_seen_or_is_not_there(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "viewer") as lab:
        await start(lab, three_texts)
        with pytest.raises(RefusedError, match="refuses us: viewer may not subscribe to /robot1/secret"):
            await Show(lab).run("/robot1/secret")
        with pytest.raises(SernError, match=r"/robot1/hidden has not appeared .* nobody publishes it"):
            await Show(lab).run("/robot1/hidden", timeout_s=0.3)


async def test_who_is_not_let_in(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "viewer") as lab:
        await lab.relay()
        (tmp_path / "stranger").mkdir()
        other = Lab(tmp_path / "stranger", "viewer", relay_port=lab.port)
        show = Show(other)
        with pytest.raises(SernError, match=f"{ENDED}|{CUT}"):
            await show.run(timeout_s=1.0)
        (other.directory / "relay.pub").write_text((tmp_path / "relay.pub").read_text())
        with pytest.raises(SernError, match="relay refused our key"):
            await Show(other).run()


async def test_no_relay(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "viewer")
    with pytest.raises(SernError, match=r"does not answer.* \(waited 0\.3 s\)"):
        await Show(lab).run(timeout_s=0.3)


def test_a_long_handshake_takes_nothing_of_the_topics_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing says that the relay is gone, and once it is there, the topic has its own time."""
    now_s = 100.0
    monkeypatch.setattr("sern_tools.echo.clock.now", lambda: now_s)
    link, transport = SimpleNamespace(established=False, peer="relay"), SimpleNamespace(rebuilds=0)
    identity = identity_from_options(Lab(tmp_path, "viewer").endpoint, None, None, "viewer")

    def check(reason: str, *, up_s: float | None = None) -> None:
        echo._check_patience("/a", identity, SimpleNamespace(link=link), transport, reason, 100.0, up_s, 0.3)  # type: ignore[arg-type]

    now_s = 109.9
    check(echo.UNHEARD)
    with pytest.raises(SernError, match=r"connecting failed \(waited 0\.3 s\)"):
        check(NOBODY)
    now_s = 110.0
    with pytest.raises(SernError, match=r"the relay does not answer \(waited 10 s\)"):
        check(echo.UNHEARD)
    link.established = True
    check(echo.UNHEARD, up_s=109.8)
    with pytest.raises(SernError, match=r"/a has not appeared at relay within 0\.3 s"):
        check(echo.UNHEARD, up_s=109.6)
    link.established = False
    with pytest.raises(SernError, match=r"lost \(waited 0\.3 s\)"):
        check(LOST, up_s=109.6)


async def test_a_running_client_is_not_pushed_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(echo, "DAEMON_S", DEADLINE_S)
    async with Lab(tmp_path, "robot1", "viewer") as lab:
        await lab.relay()
        config = lab.recorder_file("viewer", "/robot1/.*")
        viewer = lab.process(config)
        await viewer.ready()
        identity = identity_from_file(config)
        show = Show(lab)
        show.identity = identity
        with pytest.raises(UsageError, match="viewer is connected already"):
            await show.run()
        # Without that hint: the two take the session from each other, and the guest gives way.
        with pytest.raises(SernError, match=r"process connected as viewer from 127\.0\.0\.1:\d+; .*sern keygen"):
            await Show(lab).run()


async def test_the_latest_value_without_a_key(tmp_path: Path) -> None:
    """From the relay, the robot's client and the site's."""
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = lab.process(lab.relay_file())
        site = lab.process(lab.recorder_file("site", "/robot1/.*"))
        bag = write_bag(tmp_path / "a.bag", {"/text": 50})
        robot = lab.process(lab.player_file("robot1", bag, play={"rate": 1.0, "loop": True}))
        daemons = {relay: "no topic", robot: "no message of", site: "no message of"}
        for process in daemons:
            await process.ready()
        decoder = SAY["plain"]
        for process, nothing in daemons.items():
            out = StringIO()
            printer, url = Printer(decoder, out, count=1), f"http://127.0.0.1:{process.port}"
            options: dict[str, Any] = {"warn": lambda text: None}
            await poll("/robot1/text", url, printer, Shutdown(), decoder, timeout_s=DEADLINE_S, **options)
            assert out.getvalue().startswith("# robot1 seq ")
            assert read_yaml(out.getvalue().split("---\n")[0])["data"].startswith("/text ")
            with pytest.raises(SernError, match=f"{nothing} /robot1/none"):
                await poll("/robot1/none", url, printer, Shutdown(), decoder, timeout_s=0.1, **options)


async def test_a_topic_that_nobody_takes_is_said_to_be_so(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = lab.process(lab.relay_file())
        bag = write_bag(tmp_path / "a.bag", {"/text": 3})
        robot = lab.process(lab.player_file("robot1", bag, play={"wait_for": []}))
        for process in (relay, robot):
            await process.ready()
        await relay.until(lambda: relay.json("/api/topics")["announced"], "has the topic")
        shutdown, said = Shutdown(), list[str]()

        def warn(text: str) -> None:
            said.append(text)
            shutdown.request()

        decoder, url = SAY["plain"], f"http://127.0.0.1:{relay.port}"
        printer = Printer(decoder, StringIO(), count=1)
        await poll("/robot1/text", url, printer, shutdown, decoder, timeout_s=0.01, warn=warn)
        assert said[0].startswith("/robot1/text of robot1 is announced, and the relay has no message of it: ")


class Registry(BaseHTTPRequestHandler):
    """The daemon of this machine."""

    def do_GET(self) -> None:
        value = {"base64": base64.b64encode(ros_types.serialise(message_of(TEXT, data="here"), TEXT, ROS1)).decode()}
        attributes = {"topic": "/r/text", "encoding": "ros1"}
        item = {"id": "1", "version": 1, "owner": "r", "type": TEXT, "definition_key": "", "seq": 7, "value": value}
        self.send_response(200)
        self.end_headers()
        objects = (
            [item | {"attributes": attributes}] if self.path in ("/api/objects?topic=%2Fr%2Ftext", "/api/link") else []
        )
        self.wfile.write(json.dumps({"objects": objects, "definitions": {}}).encode())

    def log_message(self, *_: object) -> None:
        """Say nothing."""


def test_without_options_it_asks_the_daemon_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    with HTTPServer(("127.0.0.1", 0), Registry) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        (closed,) = free_ports(1)
        ports = (closed, server.server_port)
        monkeypatch.setattr("sern_tools.api.LOCAL_APIS", tuple(f"http://127.0.0.1:{port}" for port in ports))
        result = CliRunner().invoke(app, ["echo", "/r/text", "--count", "1"])
        server.shutdown()
        thread.join()
    assert (result.exit_code, result.stdout) == (0, '# r seq 7 latest value\ndata: "here"\n---\n'), result.output


@pytest.mark.parametrize("command", [["echo", "/r/text"], ["topics"]])
def test_no_daemon_on_this_machine(command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    ports = free_ports(2)
    monkeypatch.setattr("sern_tools.api.LOCAL_APIS", tuple(f"http://127.0.0.1:{port}" for port in ports))
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 1
    problem = f"no daemon answers on this machine (127.0.0.1, ports {ports[0]}, {ports[1]}); is one running, and is"
    assert f"sern {command[0]}: {problem}" in result.output


async def test_ctrl_c_and_a_closed_pipe_are_quiet(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "viewer") as lab:
        relay = await lab.relay(lab.relay_file(access=list(ACCESS)))
        bag = write_bag(tmp_path / "a.bag", {"/text": 50})
        await lab.connected(lab.player_file("robot1", bag, play={"rate": 1.0, "loop": True}))
        command = [sys.executable, "-P", "-m", "sern_tools.cli", "echo", "/robot1/text", "--relay", lab.endpoint]
        command += [
            "--key",
            str(tmp_path / "viewer.key"),
            "--server-key",
            str(tmp_path / "relay.pub"),
            "--timeout",
            "0",
        ]
        for closes in (False, True):
            with child(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
                assert process.stdout is not None
                assert process.stderr is not None
                os.set_blocking(process.stdout.fileno(), False)
                await until(process.stdout.read, "prints")
                if closes:
                    process.stdout.close()
                else:
                    process.send_signal(signal.SIGINT)
                await until(lambda: process.poll() is not None, "ends")
                assert (process.returncode, process.stderr.read()) == (0, b"")
        await until(lambda: ClientName("viewer") not in relay.hub.links, "nothing is kept for it")
