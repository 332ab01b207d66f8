"""`sern demo` as a person starts it: real processes, a short script, and Ctrl-C at every stage.

Figures are not judged here (the machine may be busy); what does not depend on speed is.
"""

import asyncio
import json
import os
import re
import signal
import sys
import uuid
from pathlib import Path

import pytest
import typer

from sern_tools.demo import EXIT_BROKEN, EXIT_ERROR, EXIT_INTERRUPTED, EXIT_OK, demo
from tests.support import until

PROFILES = """
profiles:
  quick:
    description: A short run with a short interruption
    link: {rate_bps: 2000000, delay_s: 0.01, queue_packets: 50, overhead_bytes: 28}
    schedule: [{at_s: 1.0, blackout_s: 0.5}]
    duration_s: 3
"""
RUN_S = 300.0
"""More than `demo.START_S`, so that a demo that waits in vain has said so."""
LIVE = "|  control "
"""What every line has that is printed while a load runs, whenever the first one comes."""
INDEPENDENT_OF_SPEED = {"reliable_faults", "corrupted_messages", "uncounted_messages"}
LATE_LOG_S = 1.0
"""A busy machine may take so much between the last check of a command's age and the line in the log."""


class Started:
    """A demo in a process, everything it prints, and whatever it left."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.mark = uuid.uuid4().hex
        self.temporary = directory / "tmp"
        self.output = ""
        self.process: asyncio.subprocess.Process | None = None
        self._reading: asyncio.Task[None] | None = None

    async def start(self, *arguments: str, own_profiles: bool = True) -> None:
        self.temporary.mkdir()
        if own_profiles:
            profiles = self.directory / "profiles.yaml"
            profiles.write_text(PROFILES)
            arguments = ("--profiles", str(profiles), *arguments)
        environment = {**os.environ, "TMPDIR": str(self.temporary), "SERN_TEST_MARK": self.mark, "COLUMNS": "80"}
        command = [sys.executable, "-m", "sern_tools.cli", "demo", *arguments]
        self.process = await asyncio.create_subprocess_exec(
            *command,
            cwd=self.directory,
            env=environment,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
        )
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        assert self.process is not None and self.process.stdout is not None
        while data := await self.process.stdout.read(4096):
            self.output += data.decode()

    async def ended(self) -> int:
        """The exit status, once it has ended."""
        assert self.process is not None and self._reading is not None
        await until(self._reading.done, "the demo ends", deadline_s=RUN_S)
        await self._reading
        return await self.process.wait()

    async def reaches(self, stage: str, *, processes: int = 0) -> asyncio.subprocess.Process:
        """Wait until it has printed `stage` and has more than so many processes; it must not end before."""
        process = self.process
        assert process is not None

        def met() -> bool:
            assert process.returncode is None, f"it ended with {process.returncode}: {self.output}"
            return stage in self.output and len(self.processes()) > processes

        await until(met, f"{stage!r} of the demo", deadline_s=RUN_S)
        return process

    def processes(self) -> list[str]:
        """The command lines of everything that carries this demo's mark."""
        found = []
        for entry in Path("/proc").iterdir():
            try:
                if entry.name.isdigit() and self.mark.encode() in (entry / "environ").read_bytes():
                    found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode())
            except OSError:
                continue  # it ended while we looked
        return found

    async def clean_up(self) -> None:
        if self.process is not None and self.process.returncode is None:
            self.process.send_signal(signal.SIGINT)
            await self.ended()

    def assert_nothing_left(self) -> None:
        assert self.processes() == []
        assert list(self.temporary.iterdir()) == []


async def test_a_whole_run_leaves_its_report_and_nothing_else(tmp_path: Path) -> None:
    demo = Started(tmp_path)
    try:
        await demo.start("--profile", "quick", "--out", "result", "--json", "figures.json", "--picture", "age.png")
        status = await demo.ended()
        assert status in (EXIT_OK, EXIT_BROKEN), demo.output
        demo.assert_nothing_left()
    finally:
        await demo.clean_up()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "age.png",
        "figures.json",
        "profiles.yaml",
        "result",
        "tmp",
    ]
    assert (tmp_path / "age.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in (tmp_path / "result").iterdir()] == ["report.html"]
    figures = json.loads((tmp_path / "figures.json").read_text())
    reach = {entry["name"]: entry["ok"] for entry in figures["reach"]}
    assert {name: ok for name, ok in reach.items() if name in INDEPENDENT_OF_SPEED} == dict.fromkeys(
        INDEPENDENT_OF_SPEED, True
    ), demo.output
    late = re.search(r"the latest ([0-9.]+) s too late", " ".join(demo.output.split()))
    assert reach["expired_commands"] or (late is not None and float(late[1]) < LATE_LOG_S), demo.output
    assert {"control_p99_s", "first_fresh_pose_s", "control_overtaken_share"} < reach.keys()
    assert status == (EXIT_OK if all(reach.values()) else EXIT_BROKEN)
    assert {row["system"] for row in figures["rows"]} == {"SERN", "plain ZMQ"}
    links = {row["system"]: row for row in figures["rows"] if row["case"] == "link"}
    ours = links["SERN"]
    assert ours["lane_udp_share"] + ours["lane_zmq_share"] == pytest.approx(1.0)
    # A run of seconds may be over before datagrams have proved themselves; the verdict says how it was.
    assert reach["datagram_share"] == (ours["lane_udp_share"] > 0.5), demo.output
    assert ours["lane_changes"] >= 0 and ours["adaptation_switches"] >= 0
    assert 0.0 <= ours["adaptation_thinned_share"] <= 1.0 and 0.0 <= ours["adaptation_summarised_share"] <= 1.0
    assert not any(name.startswith(("lane_", "adaptation_")) for name in links["plain ZMQ"])
    assert "How SERN behaved" in (tmp_path / "result" / "report.html").read_text()
    for words in ("SERN, lane:", "SERN, adaptation:", "SERN, clouds:"):
        assert words in demo.output
    for words in ("1/3  measuring", "2/3  SERN, 3 s", "3/3  the same load", "What became of the messages"):
        assert words in demo.output


@pytest.mark.parametrize(
    ("stage", "number"),
    [("1/3", signal.SIGINT), ("2/3", signal.SIGTERM), (LIVE, signal.SIGINT), ("3/3", signal.SIGHUP)],
)
async def test_ctrl_c_stops_everything_at_any_stage(tmp_path: Path, stage: str, number: signal.Signals) -> None:
    demo = Started(tmp_path)
    try:
        await demo.start("--profile", "quick", "--duration", "2")
        process = await demo.reaches(stage)
        process.send_signal(number)
        assert await demo.ended() == EXIT_INTERRUPTED, demo.output
        demo.assert_nothing_left()
    finally:
        await demo.clean_up()
    assert not (tmp_path / "demo-out").exists()
    assert "Traceback" not in demo.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--profile", "quik"], "no link profile quik (did you mean quick?)"),
        (["--profile", "quick", "--bag", "none.bag"], "none.bag: no such file or directory"),
    ],
)
async def test_what_is_wrong_is_one_line(tmp_path: Path, arguments: list[str], words: str) -> None:
    demo = Started(tmp_path)
    await demo.start(*arguments)
    assert await demo.ended() == EXIT_ERROR
    assert words in demo.output
    assert len(demo.output.splitlines()) == 1
    demo.assert_nothing_left()


def test_a_picture_without_matplotlib_is_refused_before_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(typer.Exit) as ended:
        demo(picture=Path("age.png"))
    assert ended.value.exit_code == EXIT_ERROR
    command = f"{sys.executable} -m pip install matplotlib"
    assert capsys.readouterr().err == f"sern demo: --picture needs matplotlib: {command}\n"


@pytest.mark.parametrize("stage", ["1/3", LIVE, "3/3"])
async def test_kill_9_leaves_nothing_behind(tmp_path: Path, stage: str) -> None:
    """No process, and no directory with keys."""
    demo = Started(tmp_path)
    try:
        await demo.start("--profile", "quick")
        process = await demo.reaches(stage, processes=3)
        process.kill()
        assert await demo.ended() == -signal.SIGKILL
        await until(lambda: demo.processes() == [], "every process has ended", deadline_s=RUN_S)
        demo.assert_nothing_left()
    finally:
        await demo.clean_up()
