"""The twin of a robot that only satellites place."""

import math
from typing import Any

import pytest

from sern_client.endpoints.twin import bodies
from sern_client.endpoints.twin.options import Datum, RobotOptions
from sern_core.vocabulary.errors import ConfigError
from sern_runtime import ros_types
from sern_twin.geodesy import TangentPlane
from tests.sern_client.endpoints.twin.test_twin_endpoint import World

DATUM = Datum(39.25, -76.71, 60.0)
PLANE = TangentPlane.from_degrees(DATUM.latitude_deg, DATUM.longitude_deg, DATUM.height_m)
ROVER = RobotOptions("rover", "/rover/fix", max_speed_mps=2.0, error_m=0.5, error_mps=0.5, datum=DATUM)


def say(world: World, publisher: Any, x_m: float, y_m: float, *, status: int = 0) -> None:
    latitude, longitude, height_m = PLANE.to_geodetic((x_m, y_m, 2.0)).tolist()
    new, encoding = ros_types.new, world.encoding
    message = new(
        bodies.FIX, encoding, header=ros_types.header(world.stamp_ns(world.now), "gps", encoding),
        status=new("sensor_msgs/msg/NavSatStatus", encoding, status=status),
        latitude=math.degrees(latitude), longitude=math.degrees(longitude), altitude=height_m,
    )  # fmt: skip
    publisher.tell_age(0.0)
    publisher.publish(ros_types.serialise(message, bodies.FIX, encoding), world.stamp_ns(world.now))


def drive(world: World, publisher: Any, until_s: float) -> None:
    """To the north at 1 m/s, five fixes a second."""
    while world.now < until_s - 1e-9:
        say(world, publisher, 3.0, world.now)
        world.now += 0.2


def test_its_twin_is_in_metres_of_the_site_and_goes_on_in_a_gap() -> None:
    world = World(ROVER)
    fixes = world.publisher("/rover/fix", bodies.FIX)
    drive(world, fixes, 6.0)
    shown = world.endpoint.robots["rover"].twin(now=world.now)
    assert shown is not None
    assert (shown.shown.x_m, shown.shown.y_m) == pytest.approx((3.0, 6.0), abs=0.3)
    assert shown.shown.yaw_rad == pytest.approx(math.pi / 2, abs=0.05)
    assert shown.error_m >= 0.5, "the bound begins with what a fix may be off"
    world.now = 10.0
    later = world.endpoint.robots["rover"].twin(now=world.now)
    assert later is not None and later.shown.y_m == pytest.approx(10.0, abs=0.5)
    world.endpoint.publish(slow=False)
    said = world.got["/twin/rover/odom"][-1]
    assert said.header.frame_id == "map" and said.child_frame_id == "twin/rover/gps"
    assert said.pose.pose.position.z == pytest.approx(2.0)


def test_no_fix_and_jumps_are_counted_and_move_nothing() -> None:
    world = World(ROVER)
    fixes = world.publisher("/rover/fix", bodies.FIX)
    drive(world, fixes, 4.0)
    robot = world.endpoint.robots["rover"]
    before = robot.twin(now=world.now)
    say(world, fixes, 3.0, 4.0, status=-1)
    say(world, fixes, 60.0, 4.0)
    say(world, fixes, math.nan, math.nan)
    after = robot.twin(now=world.now)
    assert before is not None and after == before
    assert (robot.counts["no_fix"], robot.counts["jump"], robot.counts["not_finite"]) == (1, 1, 1)
    for _ in range(3):
        world.now += 0.2
        say(world, fixes, 60.0, world.now)
    assert robot.counts["relocated"] == 1, "it says so again and again: there it is"


def test_a_fix_without_a_datum_and_odometry_with_one_are_told_what_is_read() -> None:
    with pytest.raises(
        ConfigError, match=r"reads nav_msgs/msg/Odometry \(and sensor_msgs/msg/NavSatFix where the robot"
    ):
        World(RobotOptions("rover", "/rover/fix")).publisher("/rover/fix", bodies.FIX)
    with pytest.raises(ConfigError, match="the twin of rover reads sensor_msgs/msg/NavSatFix, not nav_msgs/msg/Odom"):
        World(ROVER).publisher("/rover/fix", bodies.ODOMETRY)
