"""An error of the program is logged, counted, and ends nothing else."""

import asyncio
import logging

import pytest
from prometheus_client import CollectorRegistry

from sern_runtime import pump as pumps
from sern_runtime.internal_errors import InternalErrors
from sern_runtime.metrics import Metrics
from sern_runtime.pump import Pump
from sern_runtime.zmq_socket import SendResult
from tests.support import until


def test_an_error_of_the_core_is_logged_with_its_traceback_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    errors = InternalErrors()
    registry = CollectorRegistry()
    errors.register(Metrics(registry))
    try:
        raise ZeroDivisionError("of an estimator")
    except ZeroDivisionError as error:
        errors.core(error, "robot1")
    (record,) = caplog.records
    assert record.levelno == logging.ERROR and "robot1" in record.getMessage()
    assert record.exc_info is not None and record.exc_info[0] is ZeroDivisionError
    assert registry.get_sample_value("sern_internal_errors_total", {"where": "core"}) == 1
    assert registry.get_sample_value("sern_internal_errors_total", {"where": "callback"}) == 0


async def test_what_escapes_a_callback_is_logged_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    errors = InternalErrors()
    loop = asyncio.get_running_loop()

    def fail() -> None:
        raise RuntimeError("of a callback")

    errors.watch(loop)
    try:
        loop.call_soon(fail)
        await until(lambda: errors.counts["callback"])
    finally:
        errors.unwatch(loop)
    assert errors.counts == {"core": 0, "callback": 1}
    assert any("of a callback" in (record.exc_text or str(record.exc_info)) for record in caplog.records)


class OnePort:
    """Has one datagram."""

    def __init__(self) -> None:
        self.waiting = [b"one"]

    def next_datagram(self, *, now: float) -> bytes | None:
        return self.waiting.pop() if self.waiting else None

    def next_deadline(self) -> float | None:
        return None

    def handle_timeout(self, *, now: float) -> None: ...


async def test_a_lane_whose_socket_fails_is_asked_again_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pumps, "AGAIN_S", 0.01)
    errors = InternalErrors()
    loop = asyncio.get_running_loop()
    sent: list[bytes] = []
    port = OnePort()

    def send(datagram: bytes) -> SendResult:
        if not errors.counts["callback"]:
            port.waiting.append(b"two")
            raise OSError("of a socket")
        sent.append(datagram)
        return SendResult.OK

    pump = Pump(port, send, on_gone=lambda: None)
    errors.watch(loop)
    try:
        pump.kick()
        await until(lambda: sent == [b"two"])
    finally:
        errors.unwatch(loop)
        pump.close()
    assert errors.counts["callback"] == 1
