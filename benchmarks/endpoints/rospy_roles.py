"""Peers of the ROS 1 benchmark that are rospy nodes: `/usr/bin/python3 -m benchmarks.endpoints.rospy_roles ROLE ...`.

    copy SUFFIX TOPIC=TYPE...              each topic to its name with SUFFIX, at one master
    to-zenoh FOLDER LOCATOR TOPIC=TYPE...  each topic of this master to zenoh; connects
    from-zenoh FOLDER LOCATOR TOPIC=TYPE...    what comes by zenoh to this master; listens
    clouds FILE HZ TOPIC                   publishes clouds of these points; stamps are of this host's monotonic clock
    watch TOPIC...                         says of each message that comes its topic, number and stamp, and when it was

Bodies pass as they are (AnyMsg). It runs on the Python that Debian's rospy is for: nothing of the project is imported
but `zenoh_session`, and zenoh comes from FOLDER, which is last on the path, so that all else is Debian's. By zenoh,
odometry is urgent and not batched, clouds are not, and nothing is dropped on the way: what a user of a zenoh bridge
would set, and the same that the rules of the chain say.
"""

import importlib
import json
import os
import pathlib
import struct
import sys
import time
from typing import Any

QUEUE = 1000
POINT_BYTES = 16


def rospy_node(name: str) -> Any:
    rospy = importlib.import_module("rospy")
    rospy.init_node(name, disable_rosout=True)
    return rospy


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def publisher(rospy: Any, topic: str, type_name: str) -> Any:
    return rospy.Publisher(topic, message_class(type_name), queue_size=QUEUE, tcp_nodelay=True)


def subscribe(rospy: Any, topic: str, take: Any) -> None:
    rospy.Subscriber(topic, rospy.AnyMsg, take, queue_size=QUEUE, tcp_nodelay=True, buff_size=4_000_000)


def qualities(topic: str) -> "dict[str, Any]":
    """How zenoh treats a topic."""
    zenoh = importlib.import_module("zenoh")
    urgent = topic.endswith("/odom")
    return {
        "priority": zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.DATA_LOW,
        "congestion_control": zenoh.CongestionControl.BLOCK,
        "express": urgent,
    }


def copy(suffix: str, topics: "dict[str, str]") -> None:
    rospy = rospy_node("rospy_bridge")
    for topic, type_name in topics.items():
        subscribe(rospy, topic, publisher(rospy, topic + suffix, type_name).publish)
    serve(rospy)


def to_zenoh(session: Any, topics: "dict[str, str]") -> None:
    rospy = rospy_node("to_zenoh")
    for topic in topics:
        out = session.declare_publisher(topic.strip("/"), **qualities(topic))
        subscribe(rospy, topic, lambda message, put=out.put: put(message._buff))
    serve(rospy)


def from_zenoh(session: Any, topics: "dict[str, str]") -> None:
    rospy = rospy_node("from_zenoh")
    for topic, type_name in topics.items():
        out = publisher(rospy, topic, type_name)

        def take(sample: Any, out: Any = out) -> None:
            message = rospy.AnyMsg()
            message._buff = sample.payload.to_bytes()
            out.publish(message)

        session.declare_subscriber(topic.strip("/"), take)
    serve(rospy)


def clouds(points: bytes, rate_hz: float, topic: str) -> None:
    rospy = rospy_node(topic.strip("/").replace("/", "_"))
    message = message_class("sensor_msgs/msg/PointCloud2")()
    message.data, message.height, message.width = points, 1, len(points) // POINT_BYTES
    message.point_step, message.row_step, message.is_dense = POINT_BYTES, len(points), True
    field = message_class("sensor_msgs/msg/PointField")
    message.fields = [field(name, 4 * at, 7, 1) for at, name in enumerate(("x", "y", "z", "intensity"))]
    out = rospy.Publisher(topic, type(message), queue_size=2, tcp_nodelay=True)
    print(json.dumps({"ready": True, "at_ns": time.monotonic_ns()}), flush=True)
    rate = rospy.Rate(rate_hz)
    while not rospy.is_shutdown():
        message.header.stamp = rospy.Time(nsecs=time.monotonic_ns())
        out.publish(message)
        rate.sleep()


def watch(topics: "list[str]") -> None:
    rospy = rospy_node("watch")
    for topic in topics:

        def take(message: Any, topic: str = topic) -> None:
            now_ns = time.monotonic_ns()
            seq, secs, nsecs = struct.unpack_from("<III", message._buff)
            line = json.dumps({"topic": topic, "seq": seq, "sent_ns": secs * 10**9 + nsecs, "at_ns": now_ns})
            os.write(1, line.encode() + b"\n")  # at once: every topic has a thread of its own

        subscribe(rospy, topic, take)
    serve(rospy)


def serve(rospy: Any) -> None:
    print(json.dumps({"ready": True}), flush=True)
    rospy.spin()


def session_at(folder: str, locator: str, *, listens: bool) -> Any:
    sys.path.append(folder)
    from benchmarks.zenoh_session import open_session

    return open_session([locator], listens=listens)


def main(role: str, *arguments: str) -> None:
    if role == "clouds":
        clouds(pathlib.Path(arguments[0]).read_bytes(), float(arguments[1]), arguments[2])
        return
    if role == "watch":
        watch(list(arguments))
        return
    count = 1 if role == "copy" else 2
    topics = dict(each.split("=") for each in arguments[count:])
    if role == "copy":
        copy(arguments[0], topics)
    elif role == "to-zenoh":
        with session_at(*arguments[:2], listens=False) as session:
            to_zenoh(session, topics)
    elif role == "from-zenoh":
        with session_at(*arguments[:2], listens=True) as session:
            from_zenoh(session, topics)
    else:
        raise SystemExit(f"no role {role}")


if __name__ == "__main__":
    main(*sys.argv[1:])
