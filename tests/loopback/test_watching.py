"""`sern clients`, `sern events` and `sern top` over real daemons: who is there, what happened, why a topic is not."""

import asyncio
import json
import os
import signal
import sys
import termios
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, Final

import pytest

from sern_client.daemon import ClientDaemon
from sern_relay.daemon import RelayDaemon
from sern_tools.terminal import ENTER, LEAVE
from tests.daemons import Lab
from tests.support import DEADLINE_S, until

ROBOT: Final = {"kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered", "/tf_static", "/points"]}
OPERATOR: Final = {"kind": "synthetic", "role": "operator", "command_rate_hz": 0, "goal_rate_hz": 0}


def api(daemon: RelayDaemon | ClientDaemon) -> str:
    return f"http://{daemon.loaded.model.http.listen}"


@asynccontextmanager
async def started(*words: str, before: tuple[str, ...] = (), **options: Any) -> AsyncIterator[Process]:
    """A `sern` command, behind the command `before`; ended at the end."""
    process = await asyncio.create_subprocess_exec(
        *before, sys.executable, "-m", "sern_tools.cli", *words, **({"stdout": PIPE, "stderr": PIPE} | options)
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
        for stream in (process.stdout, process.stderr):  # what is left, and its end
            if stream is not None:
                await stream.read()


async def said(*words: str) -> str:
    """The whole output of a command that must succeed."""
    async with started(*words) as process:
        out, err = await asyncio.wait_for(process.communicate(), DEADLINE_S)
        assert process.returncode == 0, err.decode()
        return out.decode()


async def event(process: Process, **wanted: Any) -> dict[str, Any]:
    """Read events until one has these values."""
    assert process.stdout is not None
    while True:
        line = await asyncio.wait_for(process.stdout.readline(), DEADLINE_S)
        assert line, "the stream has ended"
        found: dict[str, Any] = json.loads(line)
        if wanted.items() <= found.items():
            return found


async def test_a_relay_says_who_is_there_who_was_refused_and_what_happens(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "laptop") as lab:
        relay = await lab.relay()
        port = relay.loaded.model.http.listen
        async with started("events", "--api", api(relay), "-n", "100") as follower:
            await event(follower, kind="started")
            robot = await lab.connected(lab.client_file("robot1", ROBOT))
            came = await event(follower, kind="connected", about="robot1")
            assert came["address"].startswith("127.0.0.1:")
            stranger = lab.client_file("stranger", ROBOT)
            (lab.clients_dir / "stranger.pub").unlink()
            refused = await lab.client(stranger)
            knock = await event(follower, kind="refused", about="127.0.0.1")
            assert knock["reason"].startswith("unknown key ")
            await lab.drop(refused)

            told = json.loads(await said("clients", "--api", api(relay), "--json", "--interval", "0.1"))
            rows = {row["name"]: row for row in told["clients"]}
            assert rows.keys() == {"robot1", "laptop"}
            assert (rows["robot1"]["state"], rows["laptop"]["state"]) == ("connected", "never")
            assert rows["robot1"]["address"] == came["address"]
            assert rows["robot1"]["received_bytes"] > 0
            assert told["refused"][0]["key"] in knock["reason"]
            table = await said("clients", "--api", api(relay), "--interval", "0.1")
            assert "127.0.0.1: unknown key" in table

            await lab.end(robot)
            gone = await event(follower, kind="away", about="robot1")
            assert gone["reason"] == "robot1 closed the session: client stops"
            await lab.end(relay)
            again = await lab.relay(lab.relay_file(http={"listen": port}))
            await event(follower, kind="restarted")
            await event(follower, kind="started", number=1)
            follower.send_signal(signal.SIGINT)
            assert follower.stderr is not None
            complaints = (await follower.stderr.read()).decode().splitlines()
            assert await follower.wait() == 0
            assert complaints[-1].endswith("it was started anew")
        await lab.end(again)


async def topics(daemon: RelayDaemon | ClientDaemon) -> dict[str, tuple[str, str]]:
    told = json.loads(await said("top", "--once", "--json", "--interval", "0.2", "--api", api(daemon)))
    return {line["topic"]: (line["level"], line["why"]) for line in told["topics"]}


async def test_top_says_at_robot_relay_and_site_why_the_points_are_missing(tmp_path: Path) -> None:
    access = [
        {"client": "robot1", "publish": ["/robot1/(odometry|tf_static).*"], "subscribe": []},
        {"client": "site", "publish": [], "subscribe": ["/robot1/[op].*"]},
    ]
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.relay(lab.relay_file(access=access))
        robot = await lab.connected(lab.client_file("robot1", ROBOT))
        wanted = ["/robot1/odometry/filtered", "/robot1/points", "/robot1/tf_static"]
        site = await lab.connected(lab.client_file("site", OPERATOR, subscribe=wanted))
        flowing = "/robot1/odometry/filtered"
        await until(lambda: site.topics().get(flowing, {}).get("delivered", 0) > 20, "poses come")
        await until(lambda: robot.bridge.outbound.refused, "the relay has refused the points")

        at_robot = await topics(robot)
        assert at_robot[flowing][0] == "ok"
        assert at_robot["/robot1/points"][1].startswith("access denied: robot1 may not publish /robot1/points")
        assert at_robot["/robot1/tf_static"][0] == "ok"  # latched: the relay takes it for who comes late
        at_site = await topics(site)
        assert at_site[flowing][0] == "ok"
        assert at_site["/robot1/tf_static"][1].startswith("access denied: site may not subscribe to /robot1/tf_static")
        assert at_site["/robot1/points"][1].startswith("robot1 is connected and does not offer it")
        at_relay = await topics(relay)
        assert at_relay[flowing][0] == "ok"
        assert at_relay["/robot1/tf_static"] == ("note", "nobody subscribes to it")

        await lab.end(robot)
        await until(lambda: "gone" in site.link_state.detail(), "the site knows that it is gone")
        level, why = (await topics(site))[flowing]
        assert (level, why.startswith("robot1 is gone for ")) == ("bad", True)
        text = await said("top", "--interval", "0.2", "--api", api(site))  # no terminal: once
        assert "\x1b" not in text
        assert "robot1 gone for" in text
        await lab.end(relay)
        await until(lambda: not site.readiness().ok, "its link is down")
        told = json.loads(await said("top", "--once", "--json", "--interval", "0.2", "--api", api(site)))
        assert told["links"][0]["state"] == "away"
        assert told["links"][0]["why"]
        (line,) = [line for line in told["topics"] if line["topic"] == flowing]
        assert (line["level"], line["why"]) == ("bad", "there is no link to the relay")
        await lab.end(site)


class Pty:
    """A terminal of 80 columns and 24 lines in which a program runs."""

    def __init__(self) -> None:
        self.ours, self.theirs = os.openpty()
        termios.tcsetwinsize(self.theirs, (24, 80))
        os.set_blocking(self.ours, False)
        self.text = ""
        self.mode = termios.tcgetattr(self.theirs)

    def shows(self, words: str) -> bool:
        with suppress(BlockingIOError):
            self.text += os.read(self.ours, 65536).decode()
        return words in self.text

    def close(self) -> None:
        os.close(self.ours)
        os.close(self.theirs)


@pytest.mark.parametrize("end", ["q", "\x03", "SIGTERM"])
async def test_the_terminal_is_given_back_as_it_was(tmp_path: Path, end: str) -> None:
    async with Lab(tmp_path) as lab:
        relay = await lab.relay()
        terminal = Pty()
        try:
            words = ("top", "--interval", "0.2", "--api", api(relay))
            streams = dict.fromkeys(("stdin", "stdout", "stderr"), terminal.theirs)
            environment = {**os.environ, "TERM": "xterm", "COLUMNS": "", "LINES": ""}
            # With a session of its own Ctrl-C there is a signal.
            async with started(*words, before=("setsid", "--ctty"), env=environment, **streams) as process:
                await until(lambda: terminal.shows("relay relay at "), "the screen is drawn")
                assert ENTER in terminal.text
                assert termios.tcgetattr(terminal.theirs) != terminal.mode
                if end == "SIGTERM":
                    process.send_signal(signal.SIGTERM)
                else:
                    os.write(terminal.ours, end.encode())
                await until(lambda: terminal.shows(LEAVE) and process.returncode is not None, "it ends")
                assert process.returncode == (128 + signal.SIGTERM if end == "SIGTERM" else 0)
                assert termios.tcgetattr(terminal.theirs) == terminal.mode
                assert terminal.text.count(LEAVE) == 1
        finally:
            terminal.close()
        await lab.end(relay)
