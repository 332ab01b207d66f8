"""Relays and clients as their user runs them: from configuration files, with keys, on free ports.

`Lab` writes the files and starts daemons, each in a process of its own (`process`) or in this one (`relay`, `client`).
Whatever it started, it ends: processes get SIGTERM and must exit 0, and are killed when the test has failed.
"""

import http.client
import json
import os
import signal
import subprocess
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, cast

import pytest
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_typestore

from sern_client.action_conversion.endpoint import ActionEndpoint
from sern_client.daemon import ClientDaemon
from sern_client.endpoints.base import Endpoint
from sern_core.objects.changes import OBJECTS_TOPIC
from sern_core.vocabulary.types import ClientName, TopicName
from sern_relay.daemon import RelayDaemon
from sern_runtime.config.client import load_client
from sern_runtime.config.keys import SecretKey
from sern_runtime.config.relay import load_relay
from sern_tools.harness.files import client_content, relay_content, write
from sern_tools.harness.processes import bound, daemon
from sern_tools.keygen import write_pair
from sern_tools.ports import free_ports
from tests.support import DEADLINE_S, until

HOST: Final = "127.0.0.1"
CALLER_HOST: Final = "127.0.0.2"
"""Where polling comes from: from HOST itself, a port that nobody listens on yet could be given to the very call that
asks whether it answers, which would then be connected to itself."""
RELIABLE: Final = ({"match": ".*", "class": "state", "reliability": "reliable"},)
STOP_S: Final = 60.0
START_NS: Final = 1_700_000_000_000_000_000

Json = dict[str, Any]


def recording(name: str) -> Path:
    """A real recording beside the checkout; skips the test where it is absent."""
    path = Path(__file__).resolve().parents[1] / "../shared/data" / name
    if not path.exists():
        pytest.skip(f"the recording {name} is not beside this checkout: put it into ../shared/data")
    return path.resolve()


def write_bag(path: Path, topics: Mapping[str, int], *, latched: Iterable[str] = (), start: int = 1) -> Path:
    """A ROS 1 bag of std_msgs/String, `topics` maps name to number of messages, 1 ms apart; texts are numbered."""
    store = get_typestore(Stores.ROS1_NOETIC)
    text = "std_msgs/msg/String"
    with Writer1(path) as writer:
        connections = {
            name: writer.add_connection(name, text, typestore=store, latching=int(name in latched)) for name in topics
        }
        for number in range(max(topics.values())):
            for name, count in topics.items():
                if number < count:
                    message = store.types[text](data=f"{name} {number + start}")
                    body = bytes(store.serialize_ros1(message, text))
                    writer.write(connections[name], START_NS + number * 1_000_000, body)
    return path


def bodies(path: Path) -> dict[str, list[bytes]]:
    """What a recording holds: bodies by topic, in their order."""
    found: dict[str, list[bytes]] = defaultdict(list)
    reader = Reader1(path) if path.suffix == ".bag" else Reader2(path)
    with reader:
        for connection, _time_ns, body in reader.messages():
            found[connection.topic].append(bytes(body))
    return dict(found)


def under(namespace: str, content: Mapping[str, list[bytes]]) -> dict[str, list[bytes]]:
    """The same with `namespace` before every name."""
    return {f"/{namespace}{name}": texts for name, texts in content.items()}


def balance(topics: Mapping[str, Any]) -> list[str]:
    """What does not add up in the counters of one link: offered = delivered + dropped + queued + in flight."""
    return [
        f"{topic}: {counters}"
        for topic, counters in topics.items()
        if counters["direction"] == "send"
        and counters["offered"]
        != counters["delivered"] + sum(counters["dropped"].values()) + counters["in_queue"] + counters["in_flight"]
    ]


class Process:
    """A daemon in a process of its own. Its standard error is in `log`."""

    def __init__(self, name: str, program: str, config: Path, *, before: Sequence[str] = ()) -> None:
        self.name = name
        self.config = config
        self.log = config.with_suffix(".log")
        self._before = before
        self._program = program
        self._from = 0
        self._port = 0
        with self.log.open("ab") as stream:
            self._from = stream.tell()
            command = bound([*before, *daemon(program, config)])
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, cwd=config.parent
            )

    @property
    def text(self) -> str:
        """What this run of it has written so far."""
        return self.log.read_bytes()[self._from :].decode()

    @property
    def lines(self) -> list[str]:
        return self.text.splitlines()

    @property
    def port(self) -> int:
        """Its HTTP port, as its file said when it was first asked."""
        if not self._port:
            content: Json = json.loads(self.config.read_text())
            self._port = int(content["http"]["listen"].rpartition(":")[2])
        return self._port

    def get(self, path: str) -> tuple[int, str]:
        """Status and body of a GET; (0, "") while nobody listens, and where there is no answer in a test's deadline."""
        connection = http.client.HTTPConnection(HOST, self.port, timeout=DEADLINE_S, source_address=(CALLER_HOST, 0))
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        except (ConnectionError, TimeoutError):
            return 0, ""
        finally:
            connection.close()

    def json(self, path: str) -> Any:
        status, text = self.get(path)
        assert status == 200, f"{self.name} answers {path} with {status}: {text}"
        return json.loads(text, parse_constant=pytest.fail)

    async def ready(self) -> Self:
        await self.until(lambda: self.get("/readyz")[0] == 200, "ready")
        return self

    async def said(self, *words: str) -> None:
        """Wait for a line that holds all the words."""
        await self.until(lambda: any(all(word in line for word in words) for line in self.lines), f"says {words}")

    async def until(self, condition: Any, what: str) -> None:
        def met() -> bool:
            if condition():
                return True
            code = self.process.poll()
            assert code is None, f"{self.name} ended with {code}:\n{self.text}"
            return False

        await until(met, f"{self.name} {what}")

    def signal(self, number: int = signal.SIGTERM) -> None:
        self.process.send_signal(number)

    async def ended(self) -> int:
        """Wait for its end; its exit code."""
        await until(lambda: self.process.poll() is not None, f"{self.name} ends", deadline_s=STOP_S)
        return int(self.process.returncode)

    async def stop(self) -> None:
        """SIGTERM, and it must drain and exit 0."""
        self.signal()
        code = await self.ended()
        assert code == 0, f"{self.name} ended with {code}:\n{self.text}"
        assert "Traceback" not in self.text, self.text

    def kill(self) -> None:
        """kill -9: nothing is flushed, nobody is told."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def summary(self) -> Json:
        """The counters that it wrote at its end."""
        content: Json = json.loads(self.config.with_suffix(".summary.json").read_text(), parse_constant=pytest.fail)
        return content


class Lab:
    """`async with Lab(tmp_path, "robot1", "site") as lab:` a relay's address, keys for these clients, and what was
    started there. Clients that are named later get keys too, which the relay knows when it looks next."""

    def __init__(self, directory: Path, *clients: str, secure: bool = True, relay_port: int | None = None) -> None:
        self.directory = directory
        self.secure = secure
        self.port = relay_port or free_ports(1)[0]
        self.endpoint = f"tcp://{HOST}:{self.port}"
        self.clients_dir = directory / "clients"
        self.clients_dir.mkdir(exist_ok=True)
        self.make_relay_keys()
        for name in clients:
            self.make_keys(name)
        self._processes: list[Process] = []
        self._here: list[RelayDaemon | ClientDaemon] = []

    def make_relay_keys(self) -> SecretKey:
        """A new pair for the relay; relay.pub is what the clients read at their next start."""
        return write_pair(ClientName("relay"), self.directory, self.directory, replace=True)

    def make_keys(self, name: str) -> SecretKey:
        """A client's pair; the relay knows it when it looks next."""
        return write_pair(ClientName(name), self.directory, self.clients_dir, replace=True)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        try:
            for daemon in reversed(self._here):
                await daemon.stop()
            if error is None:
                for process in reversed(self._processes):
                    if process.process.poll() is None:
                        await process.stop()
        except BaseException:
            self._show()
            raise
        finally:
            if error is not None:
                self._show()
            for process in self._processes:
                process.kill()

    def _show(self) -> None:
        for process in self._processes:
            print(f"--- {process.name}\n{process.log.read_text()}")

    # --- files ------------------------------------------------------------------------------------------------------

    def _said(self, name: str) -> Json:
        """Where a daemon says what it does."""
        return {"http": {"listen": f"{HOST}:{free_ports(1)[0]}"}, "summary": f"{name}.summary.json"}

    def relay_file(self, **sections: Any) -> Path:
        """relay.yaml; `sections` replace or add to what is there by default, `relay` is merged."""
        sections = self._said("relay") | sections
        return write(self.directory, "relay", relay_content(self.endpoint, secure=self.secure, **sections))

    def client_file(self, name: str, endpoint: object, **sections: Any) -> Path:
        """NAME.yaml, with new keys unless they exist; `client` and `relay` are merged, the rest is replaced."""
        if self.secure and not (self.directory / f"{name}.key").exists():
            self.make_keys(name)
        sections = {"discovery": {"mode": "dynamic"}, "local": {"listen": False}} | self._said(name) | sections
        content = client_content(name, self.endpoint, endpoint, secure=self.secure, **sections)
        return write(self.directory, name, content)

    def recorder_file(self, name: str, *patterns: str, path: str = "", **sections: Any) -> Path:
        """A site that records what matches `patterns` into NAME.bag or NAME.mcap."""
        endpoint = {"kind": "record", "path": path or name, "overwrite": True}
        return self.client_file(name, endpoint, client={"namespace": "/"}, subscribe=list(patterns), **sections)

    def player_file(self, name: str, bag: Path, *, play: Json | None = None, **sections: Any) -> Path:
        """A robot that plays a recording as fast as it is taken, once somebody wants its topics; all reliable.
        `play` replaces settings of the endpoint."""
        endpoint: Json = {"kind": "bag", "path": str(bag), "rate": 0, "wait_for": sorted(bodies(bag))}
        endpoint |= play or {}
        return self.client_file(name, endpoint, **{"topics": list(RELIABLE), **sections})

    # --- daemons ----------------------------------------------------------------------------------------------------

    def process(self, config: Path, *, before: Sequence[str] = ()) -> Process:
        """Start a daemon in a process of its own; the file of a relay is relay.yaml, or that with a number."""
        program = "relay" if config.stem.rstrip("0123456789") == "relay" else "client"
        process = Process(config.stem, program, config, before=before)
        self._processes.append(process)
        return process

    async def relay(self, config: Path | None = None) -> RelayDaemon:
        """Start a relay in this process."""
        daemon = RelayDaemon(load_relay(config or self.relay_file()))
        self._here.append(daemon)
        await daemon.start()
        return daemon

    async def client(self, config: Path, prepare: Callable[[ClientDaemon], None] | None = None) -> ClientDaemon:
        """Start a client in this process; `prepare` sees it before it starts."""
        daemon = ClientDaemon(load_client(config))
        self._here.append(daemon)
        if prepare is not None:
            prepare(daemon)
        await daemon.start()
        return daemon

    async def connected(self, config: Path) -> ClientDaemon:
        """Start a client in this process and wait until it has a session and the relay knows what it wants and has:
        whoever comes after it sends to it from the first message on."""
        daemon = await self.client(config)
        link = daemon.core.link
        await until(lambda: link.established and link.control.settled, f"{config.stem} is connected, and was heard")
        return daemon

    async def end(self, daemon: RelayDaemon | ClientDaemon) -> None:
        """Drain and stop a daemon of this process, as SIGTERM does; its state must be consistent."""
        self._here.remove(daemon)
        try:
            if isinstance(daemon, RelayDaemon):
                daemon.hub.validate()
            else:
                daemon.core.link.validate()
            await daemon.drain()
        finally:
            await daemon.stop()

    async def drop(self, daemon: RelayDaemon | ClientDaemon) -> None:
        """Stop a daemon of this process without a word to its peers, as far as that is possible without kill -9."""
        self._here.remove(daemon)
        await daemon.stop()


def endpoint_of(daemon: ClientDaemon, kind: type[Any]) -> Any:
    """The endpoint of a client in this process, when it has one only."""
    endpoint: Endpoint = daemon.site.endpoint
    if isinstance(endpoint, ActionEndpoint):
        endpoint = endpoint.inner
    assert isinstance(endpoint, kind)
    return cast("Any", endpoint)


def topics_out(daemon: ClientDaemon) -> list[TopicName]:
    """The topics of the streams that a client has for its relay; that of its objects is none."""
    return [stream.topic for stream in daemon.core.link.outgoing.by_stream if stream.topic != OBJECTS_TOPIC]


def delivered(site: ClientDaemon | Process, topic: str | None = None) -> int:
    """How many messages a site has been given, of one topic or in all."""
    counts: dict[str, int]
    if isinstance(site, Process):
        topics = site.json("/api/topics").items()
        counts = {name: int(row["delivered"]) for name, row in topics if row["direction"] == "receive"}
    else:
        counts = {name: counters.delivered for name, counters in site.core.received.topics.items()}
    return sum(counts.values()) if topic is None else counts.get(topic, 0)


def metric(process: Process, name: str, **labels: str) -> int:
    """A metric, summed over all its series that have these labels; 0 before the daemon answers."""
    _status, text = process.get("/metrics")
    wanted = [f'{key}="{value}"' for key, value in labels.items()]
    lines = [line for line in text.splitlines() if line.startswith((f"{name} ", f"{name}{{"))]
    return sum(int(float(line.rpartition(" ")[2])) for line in lines if all(label in line for label in wanted))


def rss_bytes(process: Process) -> int:
    """Resident memory of a daemon's process."""
    pages = int(Path(f"/proc/{process.process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
