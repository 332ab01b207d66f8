#!/usr/bin/env python3
"""Prints where a robot is and how old that is, from the plain feed of SERN's relay. It needs pyzmq and nothing else.

    python3 feed.py tcp://127.0.0.1:5570 /jackal1/odometry/filtered

The topic is a nav_msgs/Odometry or a geometry_msgs/PoseStamped, of ROS 1 or ROS 2. docs/plain.md says more.
"""

import signal
import struct
import sys
import time

import zmq


def position_m(body: bytes) -> tuple:
    """x, y, z of the pose. ValueError or struct.error for bytes that are neither of the two types.

    A body begins with four bytes (the seq in ROS 1, the encapsulation in ROS 2), the stamp in eight, and frame_id
    behind its length in four. In ROS 2 a string ends in NUL, and a value stands at a multiple of its size, counted
    from byte 4.
    """
    at = 16 + struct.unpack_from("<I", body, 12)[0]
    ros2 = body[:2] == b"\0\1" and at > 16 and body[at - 1 : at] == b"\0"  # a seq of ROS 1 may be those two bytes, too
    size = 56  # of the pose in a PoseStamped: seven doubles
    if len(body) >= at + size + 8:  # longer than a PoseStamped with its padding: an Odometry
        at += -at % 4 if ros2 else 0
        at += 4 + struct.unpack_from("<I", body, at)[0]  # child_frame_id
        size = 680  # pose and twist, each with its covariance
    at += (4 - at) % 8 if ros2 else 0
    if len(body) != at + size:
        raise ValueError(f"no Odometry and no PoseStamped: {len(body)} bytes")
    return struct.unpack_from("<3d", body, at)


def main(address: str, topic: str) -> None:
    socket = zmq.Context().socket(zmq.SUB)
    socket.subscribe(topic.encode() + b"\0")  # without the NUL, /odom would be /odom_filtered as well
    socket.connect(address)  # the relay may come later, or again
    heard_s, born_s = time.monotonic(), None
    while True:
        if not socket.poll(1000):
            now_s = time.monotonic()
            last = "" if born_s is None else f": the last is {now_s - born_s:.1f} s old"
            print(f"nothing for {now_s - heard_s:.0f} s{last}", flush=True)
            continue
        while socket.poll(0):  # of several that wait here, the newest: only that one is as old as it says
            name, header, body = socket.recv_multipart()
        version, _class, _zero, seq, _stamp_ns, age_us = struct.unpack("!BBHIqQ", header)
        if version != 1:
            sys.exit(f"the feed has version {version}, this program knows version 1")
        heard_s = time.monotonic()
        born_s = heard_s - age_us * 1e-6  # on our own clock: no other one is compared with it
        try:
            what = "x {:.3f} y {:.3f} z {:.3f} m".format(*position_m(body))
        except (ValueError, struct.error):
            what = f"no Odometry and no PoseStamped, {len(body)} bytes"
        print(f"{name[:-1].decode()} {seq}: {what}, {age_us * 1e-6:.3f} s old", flush=True)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a word
    if len(sys.argv) != 3:
        sys.exit("usage: feed.py ADDRESS TOPIC")
    main(sys.argv[1], sys.argv[2])
