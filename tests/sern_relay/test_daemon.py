"""The relay's daemon: a stop at any point of its start leaves nothing behind, and what fails is said and counted."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName
from sern_relay import daemon as daemons
from sern_relay.daemon import RelayDaemon
from sern_relay.relay_metrics import register_relay
from sern_runtime.config.relay import load_relay
from sern_runtime.http import HttpServer
from sern_runtime.metrics import Metrics
from tests.daemons import Lab


class StopError(Exception):
    """Ends a start where a test wants it to end."""


def stop(*_: object, **_more: object) -> None:
    raise StopError


async def stop_later(*_: object) -> None:
    raise StopError


def config(folder: Path) -> Path:
    """The file of a relay with keys."""
    return Lab(folder, "robot1").relay_file()


def made(folder: Path) -> RelayDaemon:
    return RelayDaemon(load_relay(config(folder)))


def sockets() -> set[str]:
    """What this process has open to the outside, and what it would be woken by."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            found.add(f"{entry.name} {entry.readlink()}")
        except OSError:  # the descriptor of the listing itself
            continue
    return {each for each in found if "socket:" in each or "eventfd" in each or "timerfd" in each}


@pytest.mark.parametrize(
    ("part", "name", "instead"),
    [
        (HttpServer, "start", stop_later),
        (daemons, "ZapHandler", stop),
        (daemons, "RelayServer", stop),
        (daemons, "RelayLanes", stop),
        (daemons, "self_test", stop_later),
        (None, "", None),
    ],
    ids=["http", "zap", "server", "lanes", "self-test", "started"],
)
async def test_a_stop_at_any_point_of_the_start_leaves_nothing_behind(
    part: Any, name: str, instead: Callable[..., Any] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = config(tmp_path)
    before, tasks = sockets(), asyncio.all_tasks()
    daemon = RelayDaemon(load_relay(file))
    if instead is None:
        await daemon.start()
    else:
        monkeypatch.setattr(part, name, instead)
        with pytest.raises(StopError):
            await daemon.start()
        assert not daemon.readiness().ok
    await daemon.stop()
    assert asyncio.all_tasks() == tasks and not daemon.readiness().ok
    for _ in range(100):  # transports are closed in the loop's next rounds
        await asyncio.sleep(0)
    assert sockets() <= before


async def test_a_relay_that_never_started_drains_and_stops(tmp_path: Path) -> None:
    daemon = made(tmp_path)
    await daemon.drain()
    await daemon.stop()
    assert (tmp_path / "relay.summary.json").exists()


async def test_a_part_that_cannot_end_keeps_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = made(tmp_path)
    await daemon.start()
    server, lanes, zap = daemon.transports.server, daemon.transports.lanes, daemon.zap
    assert server is not None and lanes is not None and zap is not None
    said: list[str] = []
    ends = {"lanes": lanes.close, "server": server.close, "zap": zap.close}
    for name, part in (("lanes", lanes), ("server", server), ("zap", zap)):

        def end(name: str = name) -> None:
            said.append(name)
            ends[name]()
            raise StopError

        monkeypatch.setattr(part, "close", end)
    with pytest.raises(StopError):
        await daemon.stop()
    assert said == ["lanes", "server", "zap"]


async def test_what_is_wrong_with_an_address_is_blamed_on_it(tmp_path: Path) -> None:
    lab = Lab(tmp_path, "robot1")
    first = RelayDaemon(load_relay(lab.relay_file(http={"listen": None})))
    await first.start()
    second = RelayDaemon(load_relay(first.loaded.path))
    with pytest.raises(ConfigError) as raised:
        await second.start()
    assert raised.value.file == str(first.loaded.path) and (raised.value.key or "").startswith("relay.listen")
    await second.stop()
    await first.stop()


async def test_refusals_are_counted_by_known_codes_and_metrics_read_them(tmp_path: Path) -> None:
    daemon = made(tmp_path)
    registry = CollectorRegistry()
    register_relay(Metrics(registry), daemon)
    for code in ("forbidden", "forbidden", "made_up"):
        daemon.news.refused(ClientName("robot1"), code, "no")
    daemon.reloads.failures = 1
    text = generate_latest(registry).decode()
    for line in (
        'sern_relay_refusals_total{code="forbidden"} 2.0',
        'sern_relay_refusals_total{code="other"} 1.0',
        "sern_relay_reload_failures_total 1.0",
        "sern_relay_clients 0.0",
        "sern_relay_connections 0.0",
        'sern_relay_auth_total{result="admitted"} 0.0',
    ):
        assert f"\n{line}\n" in text
    assert "sern_relay_connections_refused_total{" not in text, "nobody listens yet"
    await daemon.stop()


async def test_a_reload_that_fails_keeps_the_old_file_and_is_shown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    daemon = made(tmp_path)
    await daemon.start()
    good = daemon.loaded.path.read_text()
    daemon.loaded.path.write_text(good.replace('"clients"', '"nobody"'))
    directory = daemon.admission.directory
    daemon.reload()
    failed = [daemon.reloads.failing]
    assert daemon.reloads.failures == 1 and daemon.admission.directory is directory
    ready = daemon.readiness()
    assert ready.ok and "reload failed, the old configuration stays" in ready.reason
    daemon.loaded.path.write_text(good)
    daemon.reload()
    failed.append(daemon.reloads.failing)
    assert failed == [True, False] and daemon.readiness() == (True, "listening")
    assert "the reload works again" in caplog.text
    await daemon.stop()
