"""What SERN is measured beside: a bare datagram (the floor), plain ZeroMQ, zenoh, rospy. Each has two ends."""

import os
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import zmq

from benchmarks.link.load import POLL_S, Kind, Load, Log, Orders, Spec, offer, ready
from benchmarks.zenoh_session import open_session

PORT: Final = 7447
NOTHING: Final[dict[str, Any]] = {}
ROS_PACKAGES: Final = Path("/usr/lib/python3/dist-packages")
ROS_MASTER: Final = f"import sys; sys.path.append({str(ROS_PACKAGES)!r}); import rosmaster; rosmaster.rosmaster_main()"
ROS_PORT: Final = 11311


def drive(spec: Spec, load: Load, orders: Orders, log: Log, send: Any) -> None:
    ready()
    for pause_s in offer(load, spec.duration_s, orders, log, send):
        time.sleep(pause_s)


def listen(orders: Orders, log: Log, wait: Any) -> None:
    """`wait` takes what arrives for about POLL_S."""
    said = False
    while not orders.stopped:
        wait()
        if log.heard and not said:
            said = True
            ready()
        orders.poll()


# --- one datagram ---------------------------------------------------------------------------------------------------


def send_datagram(sock: socket.socket, datagram: bytes) -> None:
    """Send on a connected socket. The other end may not listen yet, or no more: the kernel reports that of the
    datagram before, and does not send this one."""
    with suppress(ConnectionRefusedError):
        sock.send(datagram)


def udp_sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect((spec.address, PORT))
        drive(spec, load, orders, log, lambda _kind, body: send_datagram(sock, body))
    return NOTHING


def udp_receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("", PORT))
        sock.settimeout(POLL_S)

        def wait() -> None:
            try:
                log.arrived(sock.recv(2048))
            except TimeoutError:
                return

        listen(orders, log, wait)
    return NOTHING


# --- plain ZeroMQ -----------------------------------------------------------------------------------------------------


def zmq_sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    """One PUB socket, as it comes."""
    topics = {kind: kind.name.lower().encode() for kind in Kind}
    with zmq.Context() as context, context.socket(zmq.PUB) as out:
        out.setsockopt(zmq.LINGER, 0)
        out.connect(f"tcp://{spec.address}:{PORT}")
        drive(spec, load, orders, log, lambda kind, body: out.send_multipart((topics[kind], body)))
    return NOTHING


def zmq_receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    with zmq.Context() as context, context.socket(zmq.SUB) as inlet:
        inlet.setsockopt(zmq.LINGER, 0)
        inlet.subscribe(b"")
        inlet.bind(f"tcp://*:{PORT}")

        def wait() -> None:
            if inlet.poll(int(1000 * POLL_S)):
                log.arrived(inlet.recv_multipart()[1])

        listen(orders, log, wait)
    return NOTHING


# --- zenoh ------------------------------------------------------------------------------------------------------------


def _zenoh_session(spec: Spec, *, listens: bool) -> Any:
    """A peer; with two links, the urgent half of the priorities has one for itself."""
    ends = [f"tcp/{spec.address if not listens else '0.0.0.0'}:{PORT}"]
    if spec.system != "zenoh":
        ends = [f"{ends[0]}?prio=0-3", f"{ends[0][:-1]}{PORT % 10 + 1}?prio=4-7"]
    return open_session(ends, listens=listens)


def zenoh_sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    import zenoh

    priorities = {
        Kind.POSE: zenoh.Priority.REAL_TIME,
        Kind.MAP: zenoh.Priority.DATA,
        Kind.BULK: zenoh.Priority.DATA_LOW,
    }
    with _zenoh_session(spec, listens=False) as session:
        publishers = {
            kind: session.declare_publisher(
                f"bench/{kind.name.lower()}",
                priority=priority,
                congestion_control=zenoh.CongestionControl.DROP,
                express=kind is Kind.POSE,
            )
            for kind, priority in priorities.items()
        }
        drive(spec, load, orders, log, lambda kind, body: publishers[kind].put(body))
    return NOTHING


def zenoh_receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    with _zenoh_session(spec, listens=True) as session:
        session.declare_subscriber("bench/**", lambda sample: log.arrived(sample.payload.to_bytes()))
        listen(orders, log, lambda: time.sleep(POLL_S))
    return NOTHING


# --- rospy ------------------------------------------------------------------------------------------------------------


def missing_ros() -> list[str]:
    """Debian packages that rospy over TCPROS needs and this machine lacks."""
    needs = {
        "python3-rospy": ROS_PACKAGES / "rospy",
        "python3-std-msgs": ROS_PACKAGES / "std_msgs",
        "python3-rosmaster": ROS_PACKAGES / "rosmaster",
    }
    return [package for package, path in needs.items() if not path.exists()]


def _rospy(spec: Spec) -> tuple[Any, Any]:
    """The module, with a node begun, and the message type. The master runs on the site's side."""
    os.environ["ROS_MASTER_URI"] = f"http://{spec.address}:{ROS_PORT}"
    os.environ["ROS_IP"] = spec.own_address
    sys.path.append(str(ROS_PACKAGES))  # behind our own: only what is not there comes from the system
    import importlib

    rospy = importlib.import_module("rospy")
    rospy.init_node(spec.role, disable_signals=True, disable_rosout=True)
    return rospy, importlib.import_module("std_msgs.msg").UInt8MultiArray


def ros_sender(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    """The freshest message of each topic waits, no more."""
    rospy, kind_of_message = _rospy(spec)
    publishers = {
        kind: rospy.Publisher(f"/bench/{kind.name.lower()}", kind_of_message, queue_size=1, tcp_nodelay=True)
        for kind in Kind
    }
    drive(spec, load, orders, log, lambda kind, body: publishers[kind].publish(data=body))
    return NOTHING


def ros_receiver(spec: Spec, load: Load, orders: Orders, log: Log) -> dict[str, Any]:
    rospy, kind_of_message = _rospy(spec)
    for kind in Kind:
        topic = f"/bench/{kind.name.lower()}"
        rospy.Subscriber(topic, kind_of_message, lambda message: log.arrived(message.data), tcp_nodelay=True)
    listen(orders, log, lambda: time.sleep(POLL_S))
    return NOTHING
