"""The client's daemon: its parts begin and end in their order, and a stop at any point leaves nothing behind."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest

from sern_client.client_metrics import Counting, register_client
from sern_client.daemon import ClientDaemon
from sern_client.endpoints.base import Difference
from sern_client.link_news import SILENT
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import TopicName
from sern_runtime.config.client import load_client
from sern_runtime.http import HttpServer
from sern_runtime.metrics import Metrics
from sern_runtime.transport_watch import NOT_YET
from tests.daemons import Lab


def config(folder: Path) -> Path:
    """The file of a client whose relay is not there."""
    return Lab(folder, secure=False).client_file("robot1", {"kind": "synthetic", "role": "robot"})


def made(folder: Path) -> ClientDaemon:
    return ClientDaemon(load_client(config(folder)))


def sockets() -> set[str]:
    """What this process has open to the outside, and what it would be woken by."""
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            found.add(f"{entry.name} {entry.readlink()}")
        except OSError:  # the descriptor of the listing itself
            continue
    return {each for each in found if "socket:" in each or "eventfd" in each or "timerfd" in each}


class StopError(Exception):
    """Ends a start where a test wants it to end."""


async def _stop(*_: object) -> None:
    raise StopError


def _http(_daemon: ClientDaemon, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(HttpServer, "start", _stop)


def _endpoint(daemon: ClientDaemon, patch: pytest.MonkeyPatch) -> None:
    """One that cannot start leaves nothing itself."""
    patch.setattr(daemon.site.endpoint, "start", _stop)


def _after(part: Callable[[ClientDaemon], Any], name: str) -> Callable[[ClientDaemon, pytest.MonkeyPatch], None]:
    """Stop when this call of a part has been made."""

    def arrange(daemon: ClientDaemon, patch: pytest.MonkeyPatch) -> None:
        call = getattr(part(daemon), name)

        def stops(*args: Any, **more: Any) -> Any:
            call(*args, **more)
            raise StopError

        patch.setattr(part(daemon), name, stops)

    return arrange


@pytest.mark.parametrize(
    "arrange",
    [
        pytest.param(_http, id="http"),
        pytest.param(_endpoint, id="endpoint"),
        pytest.param(_after(lambda daemon: daemon.link_state, "start"), id="link state"),
        pytest.param(_after(lambda daemon: daemon.connection, "open"), id="connection"),
        pytest.param(_after(lambda daemon: daemon.notifier, "ready"), id="ready"),
    ],
)
async def test_a_stop_at_any_point_of_the_start_leaves_nothing_behind(
    arrange: Callable[[ClientDaemon, pytest.MonkeyPatch], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = config(tmp_path)
    before, tasks = sockets(), asyncio.all_tasks()
    daemon = ClientDaemon(load_client(file))
    arrange(daemon, monkeypatch)
    with pytest.raises(StopError):
        await daemon.start()
    await daemon.stop()
    assert asyncio.all_tasks() == tasks
    for _ in range(100):  # transports are closed in the loop's next rounds
        await asyncio.sleep(0)
    assert sockets() <= before


async def test_a_client_that_never_started_drains_and_stops(tmp_path: Path) -> None:
    daemon = made(tmp_path)
    await daemon.drain()
    await daemon.stop()
    assert (tmp_path / "robot1.summary.json").exists()


async def test_an_address_that_is_none_is_blamed_on_its_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = made(tmp_path)

    def refuse(*_: object) -> None:
        raise ConfigError("it is taken")

    monkeypatch.setattr(daemon.connection, "open", refuse)
    with pytest.raises(ConfigError) as raised:
        await daemon.start()
    assert raised.value.key == "relay.endpoint" and raised.value.file == str(daemon.loaded.path)
    await daemon.stop()


ENDS = ("connection.close", "link_state.close", "bridge.close", "site.endpoint.stop")
"""The order matters: nothing arrives any more, and then a robot is told to stand still while its endpoint is there."""


def _watch(daemon: ClientDaemon, patch: pytest.MonkeyPatch, *, broken: str = "") -> list[str]:
    said: list[str] = []
    for path in ENDS:
        part: Any = daemon
        *places, name = path.split(".")
        for place in places:
            part = getattr(part, place)
        call = getattr(part, name)

        def ended(path: str = path, call: Any = call) -> Any:
            said.append(path)
            if path == broken:
                raise StopError
            return call()

        patch.setattr(part, name, ended)
    return said


async def test_its_parts_end_from_the_relay_inwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = made(tmp_path)
    said = _watch(daemon, monkeypatch)
    await daemon.start()
    await daemon.stop()
    assert tuple(said) == ENDS


@pytest.mark.parametrize("broken", ENDS[:-1])
async def test_a_part_that_cannot_end_keeps_no_other(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = made(tmp_path)
    close = {path: getattr(daemon, path.split(".")[0]) for path in ENDS[:-1]}[broken].close
    said = _watch(daemon, monkeypatch, broken=broken)
    await daemon.start()
    with pytest.raises(StopError):
        await daemon.stop()
    assert tuple(said) == ENDS
    close()  # what the test kept it from


async def test_it_is_ready_while_the_relay_answers_and_all_is_as_it_should_be(tmp_path: Path) -> None:
    daemon = made(tmp_path)
    assert daemon.readiness() == (False, NOT_YET)
    daemon.link_down("the connection to the relay was lost")
    assert daemon.readiness() == (False, "the connection to the relay was lost")
    daemon.bridge.rejected("unknown_client", "no such client")
    assert daemon.readiness() == (False, "no such client")
    link = daemon.core.link
    link.end.established = True
    assert daemon.readiness() == (True, f"connected to {link.peer}")
    daemon.check.found = [Difference(TopicName("/pose"), "is not open there", "publisher")]
    assert daemon.readiness() == (False, "what is here is not what should be: /pose: is not open there")
    link.lane.stalled = True
    assert daemon.readiness() == (False, SILENT)
    link.lane.stalled = link.end.established = False
    await daemon.stop()


async def test_a_loss_is_said_once_and_not_while_it_stops(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    daemon = made(tmp_path)
    for reason in ("lost", "lost", "refused", "lost"):
        daemon.link_down(reason)
    said = [record.getMessage().partition(": ")[2] for record in caplog.records]
    assert said == [f"{reason}; trying again until it works" for reason in ("lost", "refused")]
    caplog.clear()
    await daemon.drain()
    daemon.link_down("client stops")
    assert caplog.records == [] and daemon.news.reason == "client stops"
    await daemon.stop()


async def test_metrics_are_read_when_they_are_asked_for(tmp_path: Path) -> None:
    daemon = made(tmp_path)
    registry = CollectorRegistry()
    register_client(
        Metrics(registry),
        Counting(
            bridge=daemon.bridge,
            relays=daemon.relays,
            link_state=daemon.link_state,
            check=daemon.check,
            guard=daemon.guard,
            adaptation=daemon.adaptation,
            errors=daemon.errors,
            collector=daemon.collector,
        ),
    )
    inbound = daemon.bridge.inbound
    inbound.publish_failures, inbound.commands.leases_fired, daemon.check.total = 3, 2, 1
    inbound.deadlines_missed[TopicName("/pose")] = 4
    text = generate_latest(registry).decode()
    for line in (
        "sern_publish_failures_total 3.0",
        "sern_command_lease_expired_total 2.0",
        "sern_endpoint_differences_total 1.0",
        'sern_deadline_missed_total{topic="/pose"} 4.0',
        "sern_command_guard_stops_total 0.0",
        "sern_bad_frames_total 0.0",
    ):
        assert f"\n{line}\n" in text
    await daemon.stop()
