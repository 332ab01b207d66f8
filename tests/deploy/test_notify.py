"""What the daemons tell systemd, with this test in its place: real processes, as a unit of Type=notify starts them."""

import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemons import Lab, Process
from tests.support import until


class Systemd:
    """Receives on NOTIFY_SOCKET."""

    def __init__(self, address: Path) -> None:
        self.told: list[str] = []
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(address))
        self.socket.setblocking(False)

    def read(self) -> list[str]:
        while True:
            try:
                self.told.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return self.told

    def count(self, state: str) -> int:
        return sum(state in message.splitlines() for message in self.read())

    @property
    def _statuses(self) -> list[str]:
        return [line for text in self.read() for line in text.splitlines() if line.startswith("STATUS=")]

    def status(self, words: str) -> bool:
        return any(words in line for line in self._statuses)

    @property
    def last_status(self) -> str:
        """What `systemctl status` shows now."""
        return self._statuses[-1]


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Systemd]:
    address = tmp_path / "notify"
    systemd = Systemd(address)
    monkeypatch.setenv("NOTIFY_SOCKET", str(address))
    monkeypatch.setenv("WATCHDOG_USEC", "15000000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    yield systemd
    systemd.socket.close()


async def ends(process: Process, systemd: Systemd) -> None:
    process.signal(signal.SIGTERM)
    assert await process.ended() == 0
    assert systemd.count("STOPPING=1") == 1


async def test_the_relay(tmp_path: Path, systemd: Systemd) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        relay = lab.process(lab.relay_file())
        await until(lambda: systemd.count("READY=1"), "ready")
        # Nobody is connected: an idle relay must not look like one that hangs.
        await until(lambda: systemd.count("WATCHDOG=1") >= 3, "pings")
        assert systemd.status("0 clients")
        assert "no progress" not in relay.log.read_text()
        relay.signal(signal.SIGHUP)
        await until(lambda: systemd.count("READY=1") == 2, "reloaded")
        assert systemd.count("RELOADING=1") == 1
        await relay.said("reloaded keys")
        good = relay.config.read_text()
        relay.config.write_text("relay: {name: relay")
        relay.signal(signal.SIGHUP)
        await until(lambda: systemd.status("reload failed, the old configuration stays: "), "says that it failed")
        # It stays: the next sweeps, which tell how many clients there are, say it too.
        sweeps = systemd.count("WATCHDOG=1")
        await until(lambda: systemd.count("WATCHDOG=1") >= sweeps + 3, "goes on")
        assert "0 clients" in systemd.last_status and "reload failed" in systemd.last_status
        relay.config.write_text(good)
        relay.signal(signal.SIGHUP)
        await until(lambda: systemd.last_status == "STATUS=0 clients, 0 streams", "says that all is well")
        await relay.said("ERROR", "the reload works again")
        assert systemd.count("STOPPING=1") == 0
        await ends(relay, systemd)


async def test_the_client(tmp_path: Path, systemd: Systemd) -> None:
    async with Lab(tmp_path, "site") as lab:
        client = lab.process(lab.recorder_file("site", "/.*"))
        # Ready without its relay: a unit that waits for the network would hold up the boot of a robot.
        await until(lambda: systemd.count("READY=1"), "ready")
        await until(lambda: systemd.count("WATCHDOG=1") >= 3, "pings")
        await until(lambda: systemd.status("link down"), "says why it is not connected")
        await lab.relay()
        await until(lambda: systemd.status("link up"), "says that the link is up")
        assert systemd.count("STOPPING=1") == 0
        await ends(client, systemd)


async def test_a_client_whose_relay_has_no_address(tmp_path: Path, systemd: Systemd) -> None:
    async with Lab(tmp_path, "site") as lab:
        relay = {"endpoint": f"tcp://no..host:{lab.port}"}  # no name server is asked for what is no name
        client = lab.process(lab.recorder_file("site", "/.*", relay=relay))
        down = "STATUS=link down: the relay's name no..host does not resolve: "
        await until(lambda: systemd.status("link down") and systemd.last_status.startswith(down), "says why")
        assert client.get("/readyz")[1].startswith(down.removeprefix("STATUS=link down: "))
        await ends(client, systemd)


async def test_idle_stores_of_durable_topics_do_not_look_stuck(tmp_path: Path, systemd: Systemd) -> None:
    async with Lab(tmp_path, "site") as lab:
        relay = lab.process(lab.relay_file(durable={"directory": "held"}))
        await until(lambda: systemd.count("WATCHDOG=1") >= 3, "pings of the relay")
        await ends(relay, systemd)
        systemd.told.clear()
        client = lab.process(lab.recorder_file("site", "/.*", durable={"directory": "kept"}))
        await until(lambda: systemd.count("WATCHDOG=1") >= 3, "pings of the client")
        assert "no progress" not in relay.log.read_text() + client.log.read_text()
        await ends(client, systemd)
