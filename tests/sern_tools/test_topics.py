"""`sern topics`: counters become rates, a relay and a client are told apart, and what is wrong is one line."""

import json
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from sern_core.topics.patterns import compile_pattern
from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_tools import api
from sern_tools.commands import app
from sern_tools.ports import free_ports
from sern_tools.topics import (
    OBJECTS_PATH,
    REREAD_S,
    UNTAKEN_NOTE,
    Counts,
    Identity,
    Row,
    Watcher,
    compare,
    parse_identities,
    parse_topics,
    run_topics,
    si,
    table,
)
from tests.daemons import Lab, write_bag
from tests.support import DEADLINE_S

URL = "http://daemon"


def sent(delivered: int, **fields: Any) -> dict[str, Any]:
    row = {"class": "state", "direction": "send", "wanted": True, "offered": 99, "delivered": delivered, "dropped": {}}
    return row | {"bytes_delivered": 10 * delivered, "in_queue": 0, "in_flight": 0} | fields


def arrived(delivered: int, **fields: Any) -> dict[str, Any]:
    row = {"class": "state", "direction": "receive", "delivered": delivered, "bytes_delivered": 10 * delivered}
    return row | {"dropped": {}, "age_s": 0.25} | fields


def relay_view(factor: int) -> dict[str, Any]:
    return {
        "links": {
            "site1": {"/r/odom": sent(8 * factor, dropped={"superseded": 2, "duplicate": 5})},
            "site2": {"/r/odom": sent(2 * factor, wanted=False, in_queue=3, in_flight=1, dropped={"lifespan": 1})},
        },
        "received": {"/r/odom": arrived(10 * factor), "/r/cmd_vel": arrived(factor, **{"class": "control"})},
    }


OBJECTS = {
    "objects": [
        {"owner": "r", "type": "nav_msgs/msg/Odometry", "attributes": {"topic": "/r/odom", "encoding": "ros1"}},
        {"owner": "r", "type": "geometry_msgs/msg/TransformStamped", "attributes": {"topic": "/tf"}},
        {"owner": "r", "type": "tf2_msgs/msg/TFMessage", "attributes": {"topic": "/tf", "encoding": "ros1"}},
        {"owner": "s", "type": "tf2_msgs/msg/TFMessage", "attributes": {"topic": "/tf", "encoding": "ros1"}},
        {"owner": "r", "type": "sern/client", "attributes": {"namespace": "/r"}},
    ]
}


def test_a_relay_has_the_sum_of_its_links() -> None:
    odom = parse_topics(relay_view(1))["/r/odom"]
    assert (odom.received, odom.delivered, odom.queued, odom.subscribers, odom.age_s) == (10, 10, 4, 1, 0.25)
    assert odom.reasons == {"superseded": 2, "lifespan": 1}  # a duplicate is no loss


def test_what_nobody_takes_is_listed_with_a_mark() -> None:
    announced = {"/r/odom": {"class": "state", "taken": True}, "/r/log": {"class": "bulk", "taken": False}}
    rows = compare({}, parse_topics(relay_view(1) | {"announced": announced}), 1.0, parse_identities(OBJECTS))
    assert [(row.topic, row.untaken) for row in rows] == [("/r/cmd_vel", False), ("/r/odom", False), ("/r/log", True)]
    for width in (60, 120):
        lines = text_of(rows, width).splitlines()
        assert [line.split()[1] == "*" for line in lines[1:4]] == [False, False, True]
        assert " ".join(lines[4:]).split() == UNTAKEN_NOTE.split()
    assert "*" not in text_of(rows[:2], 120)


def test_topics_of_all_relays_are_listed_with_the_relay_of_their_owner() -> None:
    announced = {
        "/r/odom": {"class": "state", "taken": True, "owners": ["r"], "relays": ["hub1"]},
        "/tf": {"class": "state", "taken": True, "owners": ["r"], "relays": ["hub1"]},
    }
    elsewhere = {
        "/s/log": {"class": "bulk", "taken": False, "owners": ["s"], "relays": ["hub2"]},
        "/tf": {"class": "state", "taken": False, "owners": ["s"], "relays": ["hub2"]},
    }
    answer = relay_view(1) | {"announced": announced, "elsewhere": elsewhere}
    rows = compare({}, parse_topics(answer), 1.0, parse_identities(OBJECTS))
    assert [(row.topic, row.relay, row.untaken) for row in rows] == [
        ("/r/cmd_vel", None, False), ("/r/odom", "hub1", False), ("/tf", "hub1,hub2", False), ("/s/log", "hub2", True),
    ]  # fmt: skip
    text = text_of(rows, 200)
    assert "relay" in text.splitlines()[0] and "hub1,hub2" in text
    assert "relay" not in text_of(compare({}, parse_topics(relay_view(1)), 1.0, {}), 200)


def test_a_client_has_one_flat_table() -> None:
    topics = parse_topics({"/r/odom": sent(4), "/r/cmd_vel": arrived(3)})
    assert (topics["/r/odom"].delivered, topics["/r/cmd_vel"].received) == (4, 3)
    assert parse_topics({}) == {}
    answer = {"/a": sent(4, type="std_msgs/msg/String", owner="r"), "/gone": arrived(3, type="", owner="")}
    assert parse_identities(answer) == {"/a": Identity("std_msgs/msg/String", "r")}


def test_owners_come_from_streams_alone() -> None:
    found = parse_identities(OBJECTS)
    assert (found["/r/odom"].owner, found["/tf"].owner, found["/tf"].type_name) == (
        "r",
        "r,s",
        "tf2_msgs/msg/TFMessage",
    )


def test_rates_are_over_the_interval_and_urgent_topics_first() -> None:
    before, now = parse_topics(relay_view(1)), parse_topics(relay_view(3))
    rows = compare(before, now, 2.0, parse_identities(OBJECTS))
    assert [row.topic for row in rows] == ["/r/cmd_vel", "/r/odom"]
    odom = rows[1]
    assert (odom.in_hz, odom.out_hz, odom.in_bytes_per_s, odom.dropped) == (10.0, 10.0, 100.0, 3)
    assert (odom.owner, rows[0].owner) == ("r", None)


def test_a_topic_that_began_anew_counts_from_nothing() -> None:
    row = compare({"/a": Counts("bulk", received=100)}, {"/a": Counts("bulk", received=3)}, 1.0, {})[0]
    assert row.in_hz == 3.0


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, ""),
        (7, "7"),
        (999, "999"),
        (1000, "1.0k"),
        (99_940, "99.9k"),
        (123_456, "123k"),
        (2.5e6, "2.5M"),
        (4e12, "4000G"),
    ],
)
def test_sizes(value: float, text: str) -> None:
    assert si(value) == text


def test_the_registry_is_read_when_a_name_is_new() -> None:
    asked: list[str] = []

    def get(_api: str, path: str) -> Any:
        asked.append(path)
        received = {"/r/odom": arrived(1), "/r/ended": arrived(1)}  # one of them has no object
        return OBJECTS if path == OBJECTS_PATH else {"links": {}, "received": received}

    clock = iter((0.0, 1.0, 2.0, 1.0 + REREAD_S))
    watcher = Watcher(URL, compile_pattern("/r/.*"), get=get, clock=lambda: next(clock))
    for _ in range(2):
        assert {row.topic: row.owner for row in watcher.rows()} == {"/r/odom": "r", "/r/ended": None}
    assert asked.count(OBJECTS_PATH) == 1
    watcher.rows()
    assert asked.count(OBJECTS_PATH) == 2


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, ["/r/odom"]),
        ({"services": True}, ["/r/go/_call/a", "/r/odom"]),
        ({"pattern": compile_pattern(".*go.*")}, None),
    ],
)
def test_streams_of_services_are_shown_when_asked_for(options: dict[str, Any], expected: list[str] | None) -> None:
    def get(_api: str, path: str) -> Any:
        answer = {"links": {}, "received": {"/r/odom": arrived(1), "/r/go/_call/a": arrived(1)}}
        return OBJECTS if path == OBJECTS_PATH else answer

    clock = iter((0.0, 1.0))
    watcher = Watcher(URL, get=get, clock=lambda: next(clock), **options)
    assert [row.topic for row in watcher.rows()] == (expected or ["/r/go/_call/a"])


def text_of(rows: list[Row], width: int) -> str:
    out = StringIO()
    Console(file=out, width=width).print(table(rows, width))
    return out.getvalue()


def test_a_narrow_terminal_keeps_what_matters_most() -> None:
    rows = compare({}, parse_topics(relay_view(1)), 1.0, parse_identities(OBJECTS))
    wide, middle, narrow = (text_of(rows, width) for width in (200, 120, 80))
    assert "nav_msgs/msg/Odometry" in wide
    assert "superseded 2 lifespan 1" in wide
    assert "superseded 2.0/s lifespan 1.0/s" in wide
    assert "Odometry" not in middle
    assert "owner" in middle
    assert "owner" not in narrow
    assert "superseded" not in narrow
    assert narrow.splitlines()[1].split() == ["/r/cmd_vel", "control", "1.0", "0.250"]


class Stub(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = {"/api/bad": b"<html>", "/api/empty": b"{}"}.get(self.path)
        status = 200 if body is not None else 500 if self.path == "/api/broken" else 404
        if self.path in ("/api/trace?topic=/x", "/api/trace?tipoc=/x"):
            status = 404 if "topic" in self.path else 400
            body = b'{"error": "topic is not known here; known: /y"}'
        if self.path == "/api/guarded":
            status = 200 if self.headers["Authorization"] == "Bearer 0123456789abcdef" else 401
            body = b"{}" if status == 200 else b"a token is needed"
        self.send_response(status)
        self.end_headers()
        self.wfile.write(body or b"")

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def stub() -> Iterator[str]:
    with HTTPServer(("127.0.0.1", 0), Stub) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_what_a_daemon_may_answer(stub: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")  # a proxy for the outside is not asked
    assert api.get_json(stub, "/api/empty") == {}
    for path, error, words in (
        ("/api/missing", api.NotFoundError, "another kind of daemon"),
        ("/api/trace?topic=/x", api.UnknownError, r"^http://127.0.0.1:\d+: topic is not known here; known: /y$"),
        ("/api/trace?tipoc=/x", UsageError, "topic is not known here; known: /y"),
        ("/api/broken", SernError, "HTTP status 500; see the daemon's log"),
        ("/api/bad", SernError, "the answer is not JSON"),
    ):
        with pytest.raises(error, match=words):
            api.get_json(stub, path)


def test_the_token_of_a_daemon_comes_from_a_file_that_the_environment_names(
    stub: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(api.TOKEN_VARIABLE, raising=False)
    monkeypatch.setattr(api, "LOCAL_APIS", (stub,))
    monkeypatch.setattr(api, "PROBED", "/api/guarded")
    with pytest.raises(api.DeniedError, match=rf"{stub} asks for a token: put the file of its http.token_file into "):
        api.local_api()
    file = tmp_path / "http.token"
    monkeypatch.setenv(api.TOKEN_VARIABLE, str(file))
    with pytest.raises(ConfigError, match=r"SERN_TOKEN_FILE: .*http.token: no such file or directory"):
        api.local_api()
    file.write_text("fedcba9876543210\n")
    with pytest.raises(api.DeniedError, match=rf"{stub} does not take the token in {file} \(SERN_TOKEN_FILE\)"):
        api.local_api()
    file.write_text("0123456789abcdef\n")
    assert api.local_api() == stub
    assert api.get_json(stub, "/api/guarded") == {}


@pytest.mark.parametrize("others", ["answers", "nobody"])
def test_a_daemon_that_hangs_is_not_taken_for_none(
    stub: str, others: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The kernel takes the connection, and nobody reads it: so does a relay that was stopped."""
    monkeypatch.setattr(api, "PROBE_S", 0.05)
    get_json = api.get_json
    with socket.create_server(("127.0.0.1", 0)) as hung:
        port = hung.getsockname()[1]

        def get(address: str, path: str, *, timeout_s: float) -> Any:
            """Wait for what answers however long this machine gives it no time."""
            hangs = address == f"http://127.0.0.1:{port}"
            return get_json(address, path, timeout_s=timeout_s if hangs else DEADLINE_S)

        monkeypatch.setattr(api, "get_json", get)
        silent = f"127.0.0.1:{port} takes connections and is silent: its daemon hangs, or it is none of SERN"
        monkeypatch.setattr(api, "PROBED", "/api/empty")
        if others == "answers":
            monkeypatch.setattr(api, "LOCAL_APIS", (f"http://127.0.0.1:{port}", stub))
            assert api.local_api() == stub
            assert capsys.readouterr().err == f"warning: {silent}; asking {stub}\n"
        else:
            monkeypatch.setattr(api, "LOCAL_APIS", (f"http://127.0.0.1:{port}",))
            with pytest.raises(SernError) as none:
                api.local_api()
            assert str(none.value) == f"no daemon answers on this machine; {silent}"


@pytest.mark.parametrize("text", ["127.0.0.1:5580", "ftp://host", "http://", "http://host:x", "http://host:99999"])
def test_an_address_must_be_one(text: str) -> None:
    with pytest.raises(UsageError, match="write it like http://127"):
        api.checked_api(text)


def test_exit_codes() -> None:
    runner = CliRunner()
    nobody = runner.invoke(app, ["topics", "--api", f"http://127.0.0.1:{free_ports(1)[0]}"])
    assert nobody.exit_code == 1
    assert nobody.stderr.count("\n") == 1
    assert "is the daemon running" in nobody.stderr
    assert runner.invoke(app, ["topics", "--api", "nonsense"]).exit_code == 2
    assert runner.invoke(app, ["topics", "(", "--api", URL]).exit_code == 2


async def test_a_real_relay_and_its_client(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = lab.process(lab.relay_file())
        site = lab.process(lab.recorder_file("site", "/robot1/text"))
        bag = write_bag(tmp_path / "a.bag", {"/text": 20, "/spare": 20})
        play = {"rate": 1.0, "loop": True, "wait_for": ["/text"]}
        robot = lab.process(lab.player_file("robot1", bag, play=play))
        for process in (relay, robot, site):
            await process.ready()

        def passed_on() -> bool:
            """Messages come, and the site has said that it takes them: the robot is asked for them before it does."""
            told = relay.json("/api/topics")
            onward = told["links"]["site"].get("/robot1/text", {})
            return "/robot1/text" in told["received"] and bool(onward.get("wanted"))

        await relay.until(passed_on, "has the topic")

        def listed(port: int, *, pattern: str | None = None) -> Any:
            out = StringIO()
            url = f"http://127.0.0.1:{port}"
            options = {"watch": False, "as_json": True, "interval_s": 0.2}
            run_topics(url, pattern, **options, out=Console(file=out))  # type: ignore[arg-type]
            return json.loads(out.getvalue())

        rows = listed(relay.port)
        assert [(row["topic"], row["owner"], row["priority"], row["untaken"]) for row in rows] == [
            ("/robot1/spare", "robot1", "state", True),  # the recording has it, and the site does not want it
            ("/robot1/text", "robot1", "state", False),
        ]
        assert {row["type_name"] for row in rows} == {"std_msgs/msg/String"}
        assert rows[1]["subscribers"] == 1
        await site.until(lambda: "/robot1/text" in site.json("/api/topics"), "has the topic")
        for client in (site, robot):
            (row,) = listed(client.port, pattern=".*/text")
            assert (row["topic"], row["owner"], row["type_name"]) == ("/robot1/text", "robot1", "std_msgs/msg/String")
        assert listed(robot.port, pattern="/none") == []


def test_watching_ends_when_the_daemon_does() -> None:
    out = StringIO()
    looks = iter(range(3))

    def pause(_interval_s: float) -> None:
        if next(looks) == 2:
            raise KeyboardInterrupt

    with HTTPServer(("127.0.0.1", 0), Listing) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        url = f"http://127.0.0.1:{server.server_port}"
        with pytest.raises(KeyboardInterrupt):
            run_topics(url, None, watch=True, as_json=True, interval_s=0.1, out=Console(file=out), pause=pause)
        server.shutdown()
        thread.join()
    assert [json.loads(line)[0]["topic"] for line in out.getvalue().splitlines()] == ["/a", "/a"]


class Listing(Stub):
    def do_GET(self) -> None:
        found = self.path == "/api/topics"
        self.send_response(200 if found else 404)
        self.end_headers()
        self.wfile.write(json.dumps({"/a": sent(1)}).encode() if found else b"")
