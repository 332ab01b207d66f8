"""Ends of `benchmarks.scaling` that are no ROS nodes: `python -m benchmarks.scaling_ends ROLE ...`.

    zmq-clouds ADDRESS FILE HZ TOPIC...     zenoh-clouds ADDRESS FILE HZ TOPIC...
    zmq-watch TOPIC...                      zenoh-watch TOPIC...

A message is a number and this host's monotonic clock (`HEAD`), and the points. What comes is told as a ROS node of the
benchmark tells it. Plain ZeroMQ and zenoh as they come; the watcher listens, and clouds connect to it.
"""

import json
import struct
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import zmq

from benchmarks.zenoh_session import open_session

PORT: Final = 7447
HEAD: Final = struct.Struct("<IQ")


def tell(topic: str, message: bytes) -> None:
    now_ns = time.monotonic_ns()
    seq, sent_ns = HEAD.unpack_from(message)
    print(json.dumps({"topic": topic, "seq": seq, "sent_ns": sent_ns, "at_ns": now_ns}), flush=True)


def ready() -> None:
    print(json.dumps({"ready": True, "at_ns": time.monotonic_ns()}), flush=True)


def publish(points: bytes, rate_hz: float, topics: Sequence[str], send: Callable[[str, bytes], object]) -> None:
    """All topics in turn, each so often a second, until the process ends."""
    ready()
    begin_s, count = time.monotonic(), 0
    while True:
        count += 1
        for topic in topics:
            send(topic, HEAD.pack(count, time.monotonic_ns()) + points)
        time.sleep(max(0.0, begin_s + count / rate_hz - time.monotonic()))


def zmq_clouds(address: str, points: bytes, rate_hz: float, topics: Sequence[str]) -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as out:
        out.connect(f"tcp://{address}:{PORT}")
        publish(points, rate_hz, topics, lambda topic, body: out.send_multipart((topic.encode(), body)))


def zmq_watch(topics: Sequence[str]) -> None:
    with zmq.Context() as context, context.socket(zmq.SUB) as inlet:
        for topic in topics:
            inlet.subscribe(topic)
        inlet.bind(f"tcp://*:{PORT}")
        ready()
        while True:
            name, body = inlet.recv_multipart()
            tell(name.decode(), body)


def zenoh_clouds(address: str, points: bytes, rate_hz: float, topics: Sequence[str]) -> None:
    with open_session([f"tcp/{address}:{PORT}"], listens=False) as session:
        out = {topic: session.declare_publisher(topic.strip("/")) for topic in topics}
        publish(points, rate_hz, topics, lambda topic, body: out[topic].put(body))


def zenoh_watch(topics: Sequence[str]) -> None:
    with open_session([f"tcp/0.0.0.0:{PORT}"], listens=True) as session:
        for topic in topics:

            def take(sample: Any, topic: str = topic) -> None:
                tell(topic, sample.payload.to_bytes())

            session.declare_subscriber(topic.strip("/"), take)
        ready()
        while True:
            time.sleep(1.0)


def main(role: str, *arguments: str) -> None:
    if role in ("zmq-watch", "zenoh-watch"):
        (zmq_watch if role == "zmq-watch" else zenoh_watch)(arguments)
        return
    address, file, rate_hz, *topics = arguments
    clouds = {"zmq-clouds": zmq_clouds, "zenoh-clouds": zenoh_clouds}[role]
    clouds(address, Path(file).read_bytes(), float(rate_hz), topics)


if __name__ == "__main__":
    main(*sys.argv[1:])
