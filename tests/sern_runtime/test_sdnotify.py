"""sd_notify, with this test in the place of systemd."""

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sern_runtime.sdnotify import Notifier, Watchdog


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    address = str(tmp_path / "notify") if request.param == "path" else f"@sern-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(address.replace("@", "\0", 1) if address.startswith("@") else address)
        receiver.setblocking(False)
        yield address, receiver


def told(receiver: socket.socket) -> str:
    return receiver.recv(4096).decode()


def test_the_states(systemd: tuple[str, socket.socket]) -> None:
    address, receiver = systemd
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": address})
    assert notifier.enabled
    notifier.ready("relay on\n two endpoints")
    assert told(receiver) == "READY=1\nSTATUS=relay on two endpoints"
    before_us = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
    notifier.reloading()
    first, _, second = told(receiver).partition("\n")
    assert first == "RELOADING=1"
    name, _, value = second.partition("=")
    assert name == "MONOTONIC_USEC"
    assert before_us <= int(value) <= time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
    notifier.ready()
    assert told(receiver) == "READY=1"
    notifier.status("3 clients")
    assert told(receiver) == "STATUS=3 clients"
    notifier.watchdog()
    assert told(receiver) == "WATCHDOG=1"
    notifier.stopping("draining")
    assert told(receiver) == "STOPPING=1\nSTATUS=draining"
    notifier.close()
    notifier.ready()
    with pytest.raises(BlockingIOError):
        told(receiver)


def test_without_systemd_nothing_happens() -> None:
    notifier = Notifier.from_environment({})
    assert not notifier.enabled
    assert notifier.watchdog_s is None
    notifier.ready("x")
    notifier.close()


def test_a_systemd_that_went_away_is_no_error(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    notifier = Notifier(str(tmp_path / "gone"))
    notifier.ready()
    notifier.close()
    assert "READY=1" in caplog.text


@pytest.mark.parametrize(
    ("environment", "expected_s"),
    [
        ({"WATCHDOG_USEC": "30000000"}, 30.0),
        ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid())}, 30.0),
        ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid() + 1)}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_interval(environment: dict[str, str], expected_s: float | None) -> None:
    assert Notifier.from_environment(environment).watchdog_s == expected_s


def test_the_watchdog_is_pinged_only_while_every_part_moves(
    systemd: tuple[str, socket.socket], caplog: pytest.LogCaptureFixture
) -> None:
    address, receiver = systemd
    notifier = Notifier(address, watchdog_s=30.0)
    progress = {"loop": 0, "zap": 0}
    watchdog = Watchdog(notifier, {name: lambda name=name: progress[name] for name in progress})  # type: ignore[misc]
    assert watchdog.interval_s == 10.0
    progress["loop"] += 1
    assert not watchdog.check()
    assert list(watchdog.stuck) == ["zap"]
    assert "no progress in zap" in caplog.text
    progress["loop"] += 1
    progress["zap"] += 5
    assert watchdog.check()
    assert list(watchdog.stuck) == []
    assert told(receiver) == "WATCHDOG=1"
    with pytest.raises(BlockingIOError):
        told(receiver)
    notifier.close()
