"""A robot that has nothing but a code gets its keys from a running relay, and connects with them."""

import asyncio
import re
import shutil
import stat
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError, SernError, UsageError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.key_changes import revoke
from sern_runtime.config.keys import KeyDirectory, fingerprint, load_public, load_secret
from sern_runtime.config.relay import load_relay
from sern_tools import enroll
from sern_tools.keygen import write_pair
from tests.daemons import HOST, Lab, Process
from tests.support import until

DEAD_ENDS = {"kind": "synthetic", "role": "robot", "topics": 1}


class Open:
    """`sern enroll open` for robot1, and what it has said."""

    def __init__(self, lab: Lab, relay_file: Path, *, replacing: bool = False) -> None:
        self.lab = lab
        self.relay_file = relay_file
        self.said: list[str] = []
        self.task = asyncio.create_task(
            enroll.open_enrolment(
                load_relay(relay_file),
                "robot1",
                listen=f"tcp://{HOST}:*",
                replacing=replacing,
                say=self.said.append,
            )
        )

    async def line(self, pattern: str) -> re.Match[str]:
        """Wait for a line."""

        def found() -> bool:
            return self.task.done() or any(re.search(pattern, line) for line in self.said)

        await until(found, f"it says {pattern}")
        matches = [match for line in self.said if (match := re.search(pattern, line))]
        assert matches, self.said
        return matches[0]

    async def told(self) -> tuple[str, str]:
        """The address and the code that the client is to have."""
        match = await self.line(r"sern enroll ask (tcp://\S+) (\S+) --out")
        return match[1], match[2]

    async def accept(self, mark: str = "") -> None:
        """What the operator does at another terminal."""
        asked = (await self.line(r"asks from 127\.0\.0\.1, fingerprint (\S+)"))[1]
        loaded = load_relay(self.relay_file)
        await asyncio.to_thread(enroll.run_accept, loaded, "robot1", mark or asked, say=self.said.append)


@asynccontextmanager
async def opened(tmp_path: Path, *, replacing: bool = False) -> AsyncIterator[tuple[Open, Process]]:
    """A running relay that knows robot2 alone, or robot1 as well, and an enrolment of robot1 there."""
    (tmp_path / "relay").mkdir()
    async with Lab(tmp_path / "relay", *(["robot1"] if replacing else []), "robot2") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        there = Open(lab, relay.config, replacing=replacing)
        try:
            yield there, relay
        finally:
            there.task.cancel()
            await asyncio.gather(there.task, return_exceptions=True)
        await relay.stop()


async def test_a_robot_enrols_and_connects(tmp_path: Path) -> None:
    robot_dir, said = tmp_path / "robot", list[str]()
    async with opened(tmp_path) as (there, _relay):
        address, code = await there.told()
        asking = asyncio.create_task(enroll.ask_enrolment(address, code, robot_dir, say=said.append))
        mark = (await there.line(r"fingerprint (\S+)"))[1]
        await until(lambda: any(mark in line for line in said), "the robot shows the same fingerprint")
        assert not (robot_dir / "robot1.key").exists() and not (there.lab.clients_dir / "robot1.pub").exists()
        await there.accept()
        await asyncio.gather(asking, there.task)
        secret = load_secret(robot_dir / "robot1.key")
        assert fingerprint(secret.public_key) == mark
        assert stat.S_IMODE((robot_dir / "robot1.key").stat().st_mode) == 0o600
        assert [key.key for key in load_public(there.lab.clients_dir / "robot1.pub").keys] == [secret.public_key]
        assert sorted(path.name for path in robot_dir.iterdir()) == ["relay.pub", "robot1.key", "robot1.pub"]
        assert not list(there.lab.clients_dir.glob(".enroll*"))
        # The relay runs, and was told of the key.
        shutil.copy(robot_dir / "robot1.key", there.lab.directory / "robot1.key")
        shutil.copy(robot_dir / "relay.pub", there.lab.directory / "relay.pub")
        robot = await there.lab.process(there.lab.client_file("robot1", DEAD_ENDS)).ready()
        await robot.stop()


async def test_an_operator_who_names_another_fingerprint_accepts_nothing(tmp_path: Path) -> None:
    async with opened(tmp_path) as (there, _relay):
        address, code = await there.told()
        robot_dir, said = tmp_path / "robot", list[str]()
        asking = asyncio.create_task(enroll.ask_enrolment(address, code, robot_dir, say=said.append))
        with pytest.raises(UsageError, match=r"asks with the fingerprint .*, and not with aaaa"):
            await there.accept("aaaa-bbbb-cccc-dddd-eeee")
        assert not asking.done() and not (there.lab.clients_dir / "robot1.pub").exists()
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        assert list(robot_dir.iterdir()) == [], "a run that was ended leaves nothing"


async def test_one_that_has_a_key_needs_replace_and_its_old_key_is_out(tmp_path: Path) -> None:
    async with opened(tmp_path, replacing=True) as (there, relay):
        old = load_public(there.lab.clients_dir / "robot1.pub").keys[0].key
        robot = await there.lab.process(there.lab.client_file("robot1", DEAD_ENDS)).ready()
        with pytest.raises(ConfigError, match="robot1 has a key already; --replace"):
            enroll.Opened(load_relay(there.relay_file), "robot1", replacing=False, say=print)
        address, code = await there.told()
        robot_dir = tmp_path / "robot"
        asking = asyncio.create_task(enroll.ask_enrolment(address, code, robot_dir, say=print))
        await there.accept()
        await asyncio.gather(asking, there.task)
        directory = KeyDirectory(there.lab.clients_dir)
        assert [key.key for _, key in directory.revoked()] == [old]
        view = relay.json("/api/keys")["clients"]["robot1"]
        assert view["valid"] == [fingerprint(load_secret(robot_dir / "robot1.key").public_key)]
        await robot.until(lambda: robot.get("/readyz")[0] == 503, "is out")
        await robot.stop()


async def test_files_that_are_there_stop_it_before_the_code_is_used(tmp_path: Path) -> None:
    async with opened(tmp_path) as (there, _relay):
        address, code = await there.told()
        robot_dir = tmp_path / "robot"
        robot_dir.mkdir()
        kept = write_pair(ClientName("robot1"), robot_dir, robot_dir)
        with pytest.raises(ConfigError, match=r"robot1\.key: exists already; --replace replaces it"):
            await enroll.ask_enrolment(address, code, robot_dir, say=print)
        assert load_secret(robot_dir / "robot1.key") == kept
        asking = asyncio.create_task(enroll.ask_enrolment(address, code, robot_dir, replacing=True, say=print))
        await there.accept()
        await asyncio.gather(asking, there.task)
        assert load_secret(robot_dir / "robot1.key") != kept


async def test_a_clock_that_differs_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with opened(tmp_path) as (there, _relay):
        address, code = await there.told()
        said: list[str] = []
        with monkeypatch.context() as patch:
            patch.setattr(enroll, "MAX_CLOCK_DIFFERENCE_S", -1.0)
            asking = asyncio.create_task(enroll.ask_enrolment(address, code, tmp_path / "robot", say=said.append))
            await there.accept()
            await asyncio.gather(asking, there.task)
        assert re.search(r"warning: this machine's clock is \d s (ahead of|behind) the relay's", said[0])


@pytest.mark.parametrize(
    ("text", "seconds"), [("10m", 600.0), ("90s", 90.0), ("2h", 7200.0), ("30", 30.0), ("0", None), ("1d", None)]
)  # fmt: skip
def test_times_are_read_as_people_write_them(text: str, seconds: float | None) -> None:
    if seconds is None:
        with pytest.raises(UsageError, match="write for example 10m"):
            enroll.duration_s(text)
    else:
        assert enroll.duration_s(text) == seconds


async def test_nobody_who_asks_is_said_to_who_would_accept(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot2") as lab:
        loaded = load_relay(lab.relay_file())
        with pytest.raises(UsageError, match="nobody asks as robot1 now"):
            enroll.run_accept(loaded, "robot1", "aaaa", say=print)


Failing = Callable[..., Path]


@pytest.mark.parametrize("step", range(3))
async def test_files_that_cannot_be_written_leave_no_secret_behind(
    tmp_path: Path, step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of three renames fails; with --replace it is done again, by another code."""
    async with opened(tmp_path) as (there, _relay):
        address, code = await there.told()
        robot_dir, done = tmp_path / "robot", list[Path]()

        def replaced(path: Path, target: Path) -> Path:
            if Path(target).parent == robot_dir and not Path(target).name.startswith("."):
                done.append(Path(target))
                if len(done) == step + 1:
                    raise OSError(28, "No space left on device")
            return genuine(path, target)

        genuine = Path.replace
        with monkeypatch.context() as patch:
            patch.setattr(Path, "replace", replaced)
            asking = asyncio.create_task(enroll.ask_enrolment(address, code, robot_dir, say=print))
            await there.accept()
            with pytest.raises(ConfigError, match="can not be written: No space left on device"):
                await asking
        assert not (robot_dir / "robot1.key").exists()
        assert not list(robot_dir.glob(".*.key"))
        revoke(there.lab.clients_dir, ClientName("robot1"), at_s=2e9)


async def test_what_is_not_enrolled_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with Lab(tmp_path, "robot2") as lab:
        monkeypatch.setattr(enroll, "LOOK_S", 0.01)
        task = enroll.open_enrolment(
            load_relay(lab.relay_file()), "robot1", listen=f"tcp://{HOST}:*", valid_s=0.05, say=print
        )  # fmt: skip
        with pytest.raises(SernError, match="robot1 is not enrolled: its time is over"):
            await task
