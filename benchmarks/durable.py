"""How many messages of 1 kB a second are acknowledged once they are on disk.

    robot   sern-client, as installed, with keys: a recording is published as fast as it is taken, and counted when it
            is on the client's disk, which has room for what the link does not carry at once. A site gets what it does
    relay   sern-relay: what it has on its own disk of what the link carries, for a site that has subscribed and is away
    memory  the same relay, robot and link without disks: messages of a reliable topic that are held for that site
    store   the store alone, with messages as fast as it takes them: no daemon, the easier case
    nats synced
            NATS JetStream, one publisher with 1,000 messages under way, file storage in a folder whose files are
            written at once (`chattr +S`): the shortest interval of syncing that there is, and the same promise. The
            nats-server of Debian 12 has no `sync_interval`
    nats    the same in an ordinary folder: it acknowledges before it syncs, which is the easier promise

Everything writes to the folder that `--directory` names, which should be on the disk that is meant.
"""

import argparse
import asyncio
import json
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from benchmarks import common
from benchmarks.asking import count, ready
from benchmarks.child import environment
from sern_client.endpoints.bag_files import BagFile
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.message import StreamId
from sern_core.vocabulary.types import ClientName, Encoding, TopicName
from sern_runtime import clock
from sern_runtime.durable.keeper import Keeper
from sern_runtime.durable.store import Described, Put, Row, Store
from sern_runtime.ros_types import topic_info
from sern_tools.harness.files import client_content, relay_content, write
from sern_tools.harness.processes import Children, daemon, killed
from sern_tools.keygen import make_keys
from sern_tools.ports import free_ports

BODY_BYTES: Final = 1000
RATE_LIMIT: Final = 5.0
NATS_SYNCED: Final = "nats synced"
NATS_SHARE: Final = 0.5
RELAY_SHARE: Final = 0.8
"""What the link carries bounds the relay's rate: the disks of robot and relay may cost a fifth of it."""
START_S: Final = 30.0
SETTLE_S: Final = 1.0
"""Until the relay knows what the site wants."""
MAX_BYTES: Final = 2 * 2**30
UNDER_WAY: Final = 1000
TOPIC: Final = "/robot1/log"


# --- SERN -----------------------------------------------------------------------------------------------------------


def _bag(path: Path, count: int) -> Path:
    file = BagFile(path)
    info = topic_info("/log", "std_msgs/msg/String", Encoding.ROS1)
    file.add(info)
    for number in range(count):
        text = b"%08d" % number * (BODY_BYTES // 8)
        file.write(info, 10**18 + number * 1000, len(text).to_bytes(4, "little") + text)
    file.finish()
    return path


async def _rate(read: Callable[[], float], seconds: float, children: Children) -> float:
    """The growth of a count in a second, once it grows at all."""

    async def begun() -> bool:
        return await asyncio.to_thread(read) > 0

    await children.until(begun, START_S, "nothing is stored")
    before, began_s = await asyncio.to_thread(read), clock.now()
    await asyncio.sleep(seconds)
    after, ended_s = await asyncio.to_thread(read), clock.now()
    children.check()
    return (after - before) / (ended_s - began_s)


async def _daemons(folder: Path, seconds: float, *, counted: str) -> float:
    """Messages a second that the robot has on disk, or the relay, or (`memory`) that the relay holds without a disk; at
    the relay for a site that is away."""
    make_keys(folder, "relay", "robot1", "site1")
    address, *https = map(str, free_ports(4))
    https = [f"127.0.0.1:{port}" for port in https]
    endpoint = f"tcp://127.0.0.1:{address}"
    disks = {name: {"durable": {"directory": name, "max_bytes": MAX_BYTES}} for name in ("held", "kept")}
    if counted != "relay":
        disks["held"] = {}
    rule: dict[str, Any] = {"match": "/log", "class": "state", "durable": True, "compression": "none"}
    if counted == "robot":
        rule["max_queue_bytes"] = MAX_BYTES
    if counted == "memory":
        disks["kept"] = {}
        rule |= {"durable": False, "reliability": "reliable"}
    access = [{"client": ".*", "publish": [".*"], "subscribe": [".*"], "max_queue_bytes": None}]
    relay: dict[str, Any] = {"http": {"listen": https[0]}, "access": access, **disks["held"]}
    write(folder, "relay", relay_content(endpoint, **relay))
    bag = _bag(folder / "run.bag", int(20_000 * (seconds + 2)))
    play = {"kind": "bag", "path": str(bag), "rate": 0, "wait_for": ["/log"]}
    robot: dict[str, Any] = {"topics": [rule], "http": {"listen": https[1]}, **disks["kept"]}
    write(folder, "robot1", client_content("robot1", endpoint, play, **robot))
    record = {"kind": "record", "path": "got", "overwrite": True}
    site: dict[str, Any] = {"client": {"namespace": "/"}, "subscribe": [TOPIC], "http": {"listen": https[2]}}
    write(folder, "site1", client_content("site1", endpoint, record, **site))
    async with killed(folder) as children:
        await children.start("relay", daemon("relay", folder / "relay.yaml"), environment=environment())
        away = await children.start("site", daemon("client", folder / "site1.yaml"), environment=environment())

        async def connected() -> bool:
            return await asyncio.to_thread(ready, https[2])

        await children.until(connected, START_S, "the site is not connected")
        await asyncio.sleep(SETTLE_S)
        if counted != "robot":
            await children.stop([away], number=signal.SIGKILL)
        await children.start("robot", daemon("client", folder / "robot1.yaml"), environment=environment())
        where = https[1] if counted == "robot" else https[0]
        name = "sern_received_messages_total" if counted == "memory" else "sern_durable_stored_total"
        return await _rate(partial(count, where, name), seconds, children)


async def _store(folder: Path, seconds: float) -> float:
    store = Store(folder)
    store.open(new_boot=1)
    stream = StreamId(ClientName("robot1"), 1, TopicName(TOPIC))
    done = 0
    room = asyncio.Event()

    def stored(puts: Sequence[Put]) -> None:
        nonlocal done
        done += len(puts)
        room.set()

    keeper = Keeper(
        store, call_soon=asyncio.get_running_loop().call_soon_threadsafe, stored=stored, max_bytes=MAX_BYTES
    )
    keeper.change(Described(stream, {}, "", (), 0))
    keeper.start()
    body, seq, began_s = bytes(BODY_BYTES), 0, clock.now()
    while clock.now() - began_s < seconds:
        while seq - done < UNDER_WAY:
            seq += 1
            keeper.put(Put(stream, Row(seq, 0, 0, body)))
        keeper.trim(stream, done)
        room.clear()
        await room.wait()
    rate = done / (clock.now() - began_s)
    keeper.close()
    return rate


# --- NATS -----------------------------------------------------------------------------------------------------------


class _Nats:
    """The part of NATS's protocol that a publisher of JetStream needs."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    async def message(self) -> bytes:
        """The body of the next message."""
        while True:
            line = await self._reader.readline()
            if line.startswith(b"MSG"):
                size = int(line.split()[-1])
                return (await self._reader.readexactly(size + 2))[:size]
            if line.startswith(b"PING"):
                self._writer.write(b"PONG\r\n")
            if not line or line.startswith(b"-ERR"):
                raise SernError(f"nats-server: {line.decode().strip() or 'the connection ended'}")

    def publish(self, subject: str, reply: str, body: bytes) -> None:
        self._writer.write(b"PUB %s %s %d\r\n%s\r\n" % (subject.encode(), reply.encode(), len(body), body))

    async def run(self, seconds: float) -> float:
        self._writer.write(b'CONNECT {"verbose":false}\r\nSUB inbox.* 1\r\n')
        config = {"name": "LOG", "subjects": ["log"], "storage": "file", "retention": "limits"}
        self.publish("$JS.API.STREAM.CREATE.LOG", "inbox.api", json.dumps(config).encode())
        answer = json.loads(await self.message())
        if "error" in answer:
            raise SernError(f"nats-server: {answer['error']}")
        body, sent, done, began_s = bytes(BODY_BYTES), 0, 0, clock.now()
        while clock.now() - began_s < seconds:
            while sent - done < UNDER_WAY:
                self.publish("log", "inbox.a", body)
                sent += 1
            if b'"error"' in await self.message():
                raise SernError("nats-server does not store a message")
            done += 1
        return done / (clock.now() - began_s)


def _synced(folder: Path) -> None:
    """Make what is written to the files of a folder be on the disk when the call returns. Raises OSError where the file
    system cannot."""
    found = subprocess.run(["chattr", "+S", str(folder)], capture_output=True, text=True, check=False)
    if found.returncode:
        raise OSError(f"chattr +S: {found.stderr.strip()}")


def _can_sync(directory: Path | None) -> bool:
    """Whether `_synced` works there."""
    with tempfile.TemporaryDirectory(dir=directory) as there:
        try:
            _synced(Path(there))
        except OSError:
            return False
    return True


async def _nats(folder: Path, seconds: float, *, synced: bool) -> float:
    store = folder / "js"
    store.mkdir()
    if synced:
        _synced(store)
    port = free_ports(1)[0]
    config = folder / "nats.conf"
    config.write_text(f'listen: "127.0.0.1:{port}"\njetstream {{ store_dir: "{store}" }}\n')
    async with killed(folder) as children:
        await children.start("nats", ["nats-server", "-c", str(config)])
        opened: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = []

        async def listens() -> bool:
            try:
                opened.append(await asyncio.open_connection("127.0.0.1", port))
            except OSError:
                return False
            return True

        await children.until(listens, START_S, "nats-server does not listen")
        reader, writer = opened[0]
        try:
            return await children.beside(_Nats(reader, writer).run(seconds))
        finally:
            writer.close()


# --- the run --------------------------------------------------------------------------------------------------------


def _run_daemons(seconds: float, counted: str, folder: Path) -> float:
    return asyncio.run(_daemons(folder, seconds, counted=counted))


def _in_folder(measure: Callable[[Path], float], directory: Path | None) -> float:
    with tempfile.TemporaryDirectory(dir=directory) as there:
        return measure(Path(there))


def bench(options: argparse.Namespace, report: common.Report) -> None:
    rounds, seconds = common.repetitions(options, (5, 5.0), quick=(1, 5.0))
    measures: dict[str, Callable[[Path], float]] = {
        **{name: partial(_run_daemons, seconds, name) for name in ("robot", "relay", "memory")},
        "store": lambda folder: asyncio.run(_store(folder, seconds)),
    }
    if shutil.which("nats-server"):
        if _can_sync(options.directory):
            measures[NATS_SYNCED] = lambda folder: asyncio.run(_nats(folder, seconds, synced=True))
        else:
            report.note(f"no {NATS_SYNCED}: the file system does not write at once (chattr +S)")
        measures["nats"] = lambda folder: asyncio.run(_nats(folder, seconds, synced=False))
    else:
        report.note("nats-server is not installed: nothing to compare with (Debian's package nats-server)")
    systems = {name: partial(_in_folder, measure, options.directory) for name, measure in measures.items()}
    found = common.interleaved(systems, rounds)
    for name, rates in found.items():
        report.row("1 kB", name, messages_hz=statistics.median(rates))
    thousands = statistics.median(found["robot"]) / 1000
    report.reach("robot: thousand messages acknowledged a second", thousands, RATE_LIMIT, at_least=True)
    kept = [disk / memory for disk, memory in zip(found["relay"], found["memory"], strict=True)]
    report.reach("relay: of the rate without disks", statistics.median(kept), RELAY_SHARE, at_least=True)
    for theirs, said in ((NATS_SYNCED, "its writes synced"), ("nats", "which acknowledges before it syncs")):
        for name in ("robot", "store") if theirs in found else ():
            shares = [mine / other for mine, other in zip(found[name], found[theirs], strict=True)]
            report.reach(
                f"{name}: of NATS JetStream's rate, {said}", statistics.median(shares), NATS_SHARE, at_least=True
            )
    report.note(f"medians of {rounds} rounds of {seconds:g} s; CURVE, loopback, no compression")


def _arguments(parser: argparse.ArgumentParser) -> None:
    common.repetition_arguments(parser)
    parser.add_argument("--directory", type=Path, help="where files go; a folder on the disk that is meant")


def main() -> int:
    return common.main("durable", bench, description=__doc__, arguments=_arguments)


if __name__ == "__main__":
    sys.exit(main())
