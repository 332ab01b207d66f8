"""What the hop is measured beside: zenoh alone, with two priorities, and NATS servers joined as hub and leaf."""

import asyncio
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from benchmarks.fabric.hop_end import ROBOT, SITE, options
from benchmarks.link.load import POLL_S, Kind, Load, Log, Orders, Spec, offer, ready, take_all
from benchmarks.link.peers import drive, listen
from sern_core.vocabulary.errors import SernError
from sern_runtime.fabric.zenoh_settings import settings

TUNED: Final = ("transport/link/tx/queue",)
"""Settings of the port that plain zenoh has at their defaults."""
NATS_PORT: Final = 4222
LEAF_PORT: Final = 7422
START_S: Final = 20.0
NATS: Final = shutil.which("nats-server") or (shutil.which("nats-server", path="/usr/sbin"))


# --- zenoh alone ----------------------------------------------------------------------------------------------------


def _zenoh(spec: Spec) -> Any:
    import zenoh

    config = zenoh.Config()
    own, other = (ROBOT, SITE) if spec.sends else (SITE, ROBOT)
    for key, value in settings(options(spec, own, other)).items():
        if key != "access_control" and not key.startswith(TUNED):
            config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def zenoh_sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    import zenoh

    with _zenoh(spec) as session:
        publishers = {
            kind: session.declare_publisher(
                f"bench/{kind.name.lower()}",
                priority=priority,
                congestion_control=zenoh.CongestionControl.DROP,
                express=kind is Kind.POSE,
            )
            for kind, priority in ((Kind.POSE, zenoh.Priority.REAL_TIME), (Kind.BULK, zenoh.Priority.BACKGROUND))
        }
        drive(spec, load, orders, log, lambda kind, body: publishers[kind].put(body))
    return {}


def zenoh_receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    del load
    with _zenoh(spec) as session:
        session.declare_subscriber("bench/**", lambda sample: log.arrived(sample.payload.to_bytes()))
        listen(orders, log, lambda: time.sleep(POLL_S))
    return {}


# --- NATS -----------------------------------------------------------------------------------------------------------


@contextmanager
def _server(spec: Spec) -> Iterator[None]:
    """A server of this end's own: the site's is the hub, to which the robot's, a leaf, connects."""
    if NATS is None:
        raise SernError("nats-server is not installed")
    lines = [f"listen: 127.0.0.1:{NATS_PORT}"]
    if spec.sends:
        lines.append(f'leafnodes {{ remotes: [ {{ url: "nats://{spec.address}:{LEAF_PORT}" }} ], reconnect: 1 }}')
    else:
        lines.append(f"leafnodes {{ listen: {spec.own_address}:{LEAF_PORT} }}")
    path = spec.path / f"{spec.role}.conf"
    path.write_text("\n".join(lines) + "\n")
    log = (spec.path / f"{spec.role}.nats.log").open("w")
    with log, subprocess.Popen([NATS, "-c", str(path)], stdout=log, stderr=log) as server:
        try:
            yield
        finally:
            server.terminate()


async def _connect() -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Speaks the protocol of NATS's clients, of which there is no package here."""
    give_up_s = time.monotonic() + START_S
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", NATS_PORT)
        except OSError:
            if time.monotonic() > give_up_s:
                raise
            await asyncio.sleep(POLL_S)
            continue
        await reader.readline()  # INFO
        writer.write(b'CONNECT {"verbose":false,"pedantic":false}\r\n')
        return reader, writer


def nats_sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    async def send() -> None:
        reader, writer = await _connect()
        pongs = asyncio.create_task(_answer(reader, writer, log))
        ready()

        def put(kind: Kind, body: bytes) -> None:
            writer.write(b"PUB bench.%d %d\r\n%b\r\n" % (kind, len(body), body))

        for pause_s in offer(load, spec.duration_s, orders, log, put):
            await asyncio.sleep(pause_s)
        pongs.cancel()
        writer.close()

    with _server(spec):
        asyncio.run(send())
    return {}


def nats_receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    del load

    async def receive() -> None:
        reader, writer = await _connect()
        writer.write(b"SUB bench.* 1\r\n")
        taking = asyncio.create_task(_answer(reader, writer, log))
        await take_all(orders, log)
        taking.cancel()
        writer.close()

    with _server(spec):
        asyncio.run(receive())
    return {}


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, log: Log) -> None:
    while line := await reader.readline():
        if line.startswith(b"MSG "):
            body = await reader.readexactly(int(line.split()[-1]) + 2)
            log.arrived(body[:-2])
        elif line.startswith(b"PING"):
            writer.write(b"PONG\r\n")
