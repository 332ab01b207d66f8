"""Shared fixtures, and the detectors: what a test starts, it stops.

Tasks are checked after every asynchronous test, contexts are terminated under a timeout, and threads, child processes
and sockets are checked once, at the end of the session.
"""

import asyncio
import gc
import os
import signal
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import pytest
import uvloop
import zmq

from sern_core.vocabulary.types import ClientName
from sern_runtime import version
from sern_runtime.config.keys import SecretKey, generate
from sern_runtime.open_files import raise_open_files
from sern_tools.ports import release_claims
from tests.exploring import load_profile
from tests.support import DEADLINE_S, LASTING, Patience, open_sockets

Context = zmq.Context[zmq.Socket[bytes]]
PEERS: Final = Path(__file__).parent / "peers"
LAB: Final = Path(__file__).parent / "lab"
LONG: Final = "lab_long"
INTERPRETED: Final = "interpreted"

for name in (
    "CYCLONEDDS_URI", "FASTRTPS_DEFAULT_PROFILES_FILE", "RMW_IMPLEMENTATION", "ROS_DISCOVERY_SERVER", "ROS_DOMAIN_ID",
    "ROS_HOSTNAME", "ROS_IP", "ROS_IPV6", "ROS_MASTER_URI", "ROS_NAMESPACE", "ZENOH_CONFIG_OVERRIDE",
    "ZENOH_SESSION_CONFIG_URI",
):  # fmt: skip
    os.environ.pop(name, None)  # a developer's own robots are none of the tests' business
os.environ["GIT_PYTHON_REFRESH"] = "quiet"  # the zenoh peer imports it, and needs no git
load_profile()
raise_open_files()  # as the daemons do, many of which run inside the tests


@pytest.hookimpl(optionalhook=True)
def pytest_asyncio_loop_factories(
    config: pytest.Config, item: pytest.Item
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Asynchronous tests run on the loop that the daemons run on."""
    return {"uvloop": uvloop.new_event_loop}


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist takes `-n` for "--dist load", which knows no groups
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Let the groups hold also where nobody says `--dist loadgroup`."""
    if getattr(config.option, "numprocesses", None) and config.option.dist in ("no", "load"):
        config.option.dist = "loadgroup"


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave the longer runs out unless they are asked for by -m (make lab), and what a compiled core cannot show.

    Ask for `no_leftover_tasks` ahead of all other fixtures, so that it is torn down after them.

    Name the groups whose tests run one after the other where several processes share the tests: those of a file, all
    with ROS peers, which share the host's ROS domains and its multicast, and all of the lab, which has the machine.
    """
    long = [] if LONG in config.getoption("markexpr", "") else [item for item in items if item.get_closest_marker(LONG)]
    if long:
        config.hook.pytest_deselected(items=long)
        items[:] = [item for item in items if item not in long]
    for item in items:
        if version.compiled() and item.get_closest_marker(INTERPRETED):
            item.add_marker(
                pytest.mark.skip(
                    reason="replaces a method of the core, which compiled code does not look up: make test runs it"
                )
            )
        if isinstance(item, pytest.Function) and asyncio.iscoroutinefunction(item.function):
            item.fixturenames.insert(0, "no_leftover_tasks")
        apart = [folder for folder in (PEERS, LAB) if folder in item.path.parents]
        group = apart[0].name if apart else str(item.path)
        item.add_marker(pytest.mark.xdist_group(group))


def pytest_collection_finish() -> None:
    """Keep the collector of circular garbage from what stays to the end, modules and tests, and let it look less often:
    it takes a twentieth of a run otherwise."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@pytest.fixture
async def no_leftover_tasks() -> AsyncIterator[None]:
    """Fails a test whose tasks outlive its fixtures."""
    before = asyncio.all_tasks()
    yield
    # Transports and cancelled tasks end in the loop's next rounds; what still runs after many will not end by itself.
    for _ in range(100):
        left = [task for task in asyncio.all_tasks() - before if task is not asyncio.current_task()]
        if not left:
            return
        await asyncio.sleep(0.001)
    for task in left:
        task.cancel()
    pytest.fail(f"tasks left running: {left}")


@pytest.fixture
def zmq_context() -> Iterator[Context]:
    """A context of the test's own. The test closes its sockets; the context must then end within the deadline."""
    context = Context()
    yield context
    left = [socket for socket in list(context._sockets) if not socket.closed]
    terminator = threading.Thread(target=context.destroy, kwargs={"linger": 0}, daemon=True)
    terminator.start()
    terminator.join(DEADLINE_S)
    assert not terminator.is_alive(), "the context did not end: a socket is used elsewhere, or lingers"
    assert not left, f"sockets left open: {left}"


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Handle signals as in a terminal: whoever started the tests may have some ignored (nohup, a shell's job)."""
    usual: dict[signal.Signals, Any] = {
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGINT: signal.default_int_handler,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def relay_keys() -> SecretKey:
    return generate(ClientName("relay"))


@pytest.fixture(scope="session")
def robot_keys() -> SecretKey:
    return generate(ClientName("robot1"))


@pytest.fixture(scope="session")
def site_keys() -> SecretKey:
    return generate(ClientName("site1"))


@pytest.fixture(scope="session")
def stranger_keys() -> SecretKey:
    """A pair that nobody knows."""
    return generate(ClientName("stranger"))


def _children() -> set[str]:
    """The children of every thread of this process."""
    found: set[str] = set()
    for task in Path("/proc/self/task").iterdir():
        try:
            found.update(f"process {pid}" for pid in (task / "children").read_text().split())
        except OSError:
            continue  # the thread ended meanwhile
    return found


def _threads() -> set[str]:
    return {thread.name for thread in threading.enumerate() if not thread.daemon}


@pytest.fixture(scope="session", autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """At the end of the session: no threads, child processes or sockets more than at its start."""
    probes = (_threads, _children, open_sockets)
    before = [probe() for probe in probes]
    yield
    release_claims()
    patience = Patience()
    while True:
        gc.collect()
        left = [item for probe, old in zip(probes, before, strict=True) for item in probe() - old - LASTING]
        if not left:
            return
        if patience.over():
            pytest.fail(f"left behind by the session: {left}")
        threading.Event().wait(0.05)
