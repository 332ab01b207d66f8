"""Where the twin and what scanners see differ, from the scans of one site to the messages of another."""

import logging
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sern_client.scene import bodies
from sern_client.scene.differing import MOST_OF_OTHERS
from sern_client.scene.hearing import Unused
from sern_core.vocabulary.types import Encoding, ObjectKind
from sern_runtime import ros_types
from sern_twin.world.discrepancy import DiscrepancyKind
from sern_twin.world.patches import FREE, OCCUPIED
from tests.sern_client.scene.test_scene_node import GRID, OPTIONS, Air, Site, around, told


def drive(robot: Site, ranges_m: Any, scans: int = 1) -> None:
    """Stand at the origin, and see this ten times a second."""
    for _ in range(scans):
        robot.now += 0.1
        robot.odometry(0.0, 0.0, 0.0, 1.0 + robot.now)
        robot.scan(ranges_m, 1.0 + robot.now)
        robot.turn()


def markers(site: Site) -> list[Any]:
    """All but the one that deletes those before."""
    first, *rest = ros_types.deserialise(
        site.published["/scene/discrepancies"][-1], bodies.MARKERS, Encoding.CDR
    ).markers
    assert first.action == 3, "it takes the place of all before"
    return list(rest)


def a_pair(**site: Any) -> tuple[Site, Site]:
    air = Air()
    return Site(air, "site", **site), Site(air, "robot")


def test_what_is_added_where_the_robot_sees_nothing_is_a_phantom_in_less_than_a_second() -> None:
    site, robot = a_pair()
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=5)
    site.now += 1.0
    site.turn()
    (phantom,) = site.node.discrepancies()
    assert (phantom.kind, phantom.owner) == (DiscrepancyKind.PHANTOM, "robot")
    assert (phantom.east_m, phantom.north_m) == pytest.approx((2.0, 0.0), abs=0.06)
    cylinder, text = markers(site)
    assert (cylinder.ns, cylinder.type, cylinder.header.frame_id) == ("phantom", 3, "odom")
    assert (cylinder.pose.position.x, cylinder.pose.position.y) == pytest.approx((2.0, 0.0), abs=0.06)
    assert cylinder.scale.x == pytest.approx(2 * phantom.radius_m, abs=0.01)
    assert (text.ns, text.type, text.text) == ("phantom_text", 9, "phantom: robot sees nothing there, free on the map")
    told_of: Any = site.node.to_json()["discrepancies"]
    assert [(each["id"], each["seen_by"]) for each in told_of] == [("/scene/yard/discrepancy/1@robot", "robot")]
    site.marker(action=2)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=8)
    site.now += 1.0
    site.turn()
    assert site.node.discrepancies() == () and markers(site) == [], "it was taken back"


def at(site: Site, x_m: float, y_m: float) -> int:
    """What the site's map has there."""
    return int(site.node.cells()[GRID.index(np.array([x_m, y_m]))])


def test_a_phantom_is_free_on_all_maps_with_the_next_update_and_stays_among_the_objects() -> None:
    site, robot = a_pair()
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    assert at(site, 2.0, 0.0) == at(robot, 2.0, 0.0) == OCCUPIED
    drive(robot, around(9.0, 9.0, 0.1), scans=2)
    assert at(robot, 2.0, 0.0) == OCCUPIED, "two scans say nothing yet"
    updates = len(robot.published.get("/scene/map_updates", ()))
    drive(robot, around(9.0, 9.0, 0.1))
    assert at(site, 2.0, 0.0) == at(robot, 2.0, 0.0) == FREE
    row, column = (int(value) for value in GRID.index(np.array([2.0, 0.0])))
    patches = [
        ros_types.deserialise(body, bodies.UPDATE, Encoding.CDR)
        for body in robot.published["/scene/map_updates"][updates:]
    ]
    (there,) = [
        patch
        for patch in patches
        if patch.x <= column < patch.x + patch.width and patch.y <= row < patch.y + patch.height
    ]
    assert np.asarray(there.data).reshape(there.height, there.width)[row - there.y, column - there.x] == FREE
    (phantom,) = site.node.discrepancies()
    assert phantom.corrected and site.node.scene.merged("twin_only")[row, column] == OCCUPIED
    shown: Any = site.node.to_json()
    assert shown["obstacles"] == 1 and shown["cleared_cells"] >= 30 and shown["discrepancies"][0]["corrected"] is True
    blind = np.full(100, math.nan)
    drive(robot, blind, scans=20)
    assert at(site, 2.0, 0.0) == FREE, "the robot looks elsewhere"


def test_a_correction_is_undone_when_scans_say_otherwise() -> None:
    site, robot = a_pair()
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=5)
    assert at(site, 2.0, 0.0) == FREE
    drive(robot, around(2.0, 0.0, 0.3), scans=2)
    assert at(robot, 1.75, 0.0) == FREE, "two scans are not sure"
    drive(robot, around(2.0, 0.0, 0.3))
    for x_m in (1.75, 1.85):
        assert at(site, x_m, 0.0) == at(robot, x_m, 0.0) == OCCUPIED


def test_what_was_taken_back_and_is_added_again_is_on_the_map_until_it_is_seen_through_again() -> None:
    site, robot = a_pair()
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=5)
    site.marker(action=2)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=8)
    assert site.node.discrepancies() == () and at(site, 2.0, 0.0) == FREE
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    drive(robot, np.full(100, math.nan), scans=3)
    assert at(site, 2.0, 0.0) == at(robot, 2.0, 0.0) == OCCUPIED
    drive(robot, around(9.0, 9.0, 0.1), scans=3)
    assert at(site, 2.0, 0.0) == FREE


def test_what_scanners_cannot_see_stays_on_the_map() -> None:
    site, robot = a_pair()
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6, namespace="lasting")
    site.marker(x_m=2.0, y_m=0.0, size_m=1.0, number=2)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=20)
    assert at(site, 2.0, 0.0) == at(robot, 2.0, 0.0) == OCCUPIED, "a hole"
    assert at(site, 2.0, 0.45) == at(robot, 2.0, 0.45) == FREE, "what somebody else put around it"


def test_a_site_may_leave_the_map_as_it_is() -> None:
    air = Air()
    site = Site(air, "site")
    robot = Site(air, "robot", options=replace(OPTIONS, corrects=False))
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=20)
    site.now += 1.0
    site.turn()
    assert at(site, 2.0, 0.0) == at(robot, 2.0, 0.0) == OCCUPIED
    (phantom,) = site.node.discrepancies()
    assert not phantom.corrected and markers(site)[1].text == "phantom: robot sees nothing there"


def test_what_the_map_has_and_the_robot_sees_through_is_free_before_all_scans_are_sure() -> None:
    base = np.full(GRID.shape, FREE, np.int8)
    base[50:58, 68:76] = OCCUPIED
    site, robot = a_pair(base=base)
    site.turn()
    drive(robot, around(9.0, 9.0, 0.1), scans=3)
    assert at(site, 2.2, 0.4) == at(robot, 2.2, 0.4) == FREE
    assert robot.node.occupancy.classes()[54, 72] != FREE, "the log-odds are not there yet"


def test_what_the_robot_sees_where_the_map_is_free_is_an_unknown_obstacle() -> None:
    free = np.full(GRID.shape, FREE, np.int8)
    distances = np.hypot(*(GRID.centres(*np.indices(GRID.shape)) + 0.0).transpose(2, 0, 1))
    free[np.abs(distances - 4.05) < 0.25] = OCCUPIED
    site, robot = a_pair(base=free)
    site.turn()
    drive(robot, around(2.0, 0.0, 0.3), scans=5)
    site.now += 1.0
    site.turn()
    (obstacle,) = robot.node.discrepancies()
    assert obstacle.kind is DiscrepancyKind.UNKNOWN_OBSTACLE and obstacle.owner == "robot"
    assert obstacle.east_m == pytest.approx(1.8, abs=0.15) and obstacle.north_m == pytest.approx(0.0, abs=0.1)
    assert [each.object_id for each in site.node.discrepancies()] == [obstacle.object_id]
    assert markers(site)[1].text == "unknown obstacle: robot sees it"
    drive(robot, around(9.0, 9.0, 0.1), scans=10)
    assert robot.node.discrepancies() == site.node.discrepancies() == (), "the car has left"


def test_a_discrepancy_is_told_when_it_changes_and_not_with_each_scan() -> None:
    site, robot = a_pair()
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    puts: list[dict[str, str]] = []
    robot.air.put = lambda _client, _id, kind, _type, _value, attributes: (  # type: ignore[method-assign, assignment]
        puts.append(attributes) if kind is ObjectKind.DISCREPANCY else None
    )
    drive(robot, around(9.0, 9.0, 0.1), scans=50)
    assert 1 <= len(puts) <= 2
    assert puts[-1]["kind"] == "phantom" and puts[-1]["frame_id"] == "odom"
    assert float(puts[-1]["east_m"]) == pytest.approx(2.0, abs=0.06)


@pytest.mark.parametrize(
    "attributes",
    [
        {},
        {"kind": "ghost"},
        {"east_m": "nan"},
        {"north_m": "1e9"},
        {"radius_m": "0"},
        {"radius_m": "-1"},
        {"radius_m": "inf"},
        {"cells": "many"},
        {"cells": "0"},
    ],
    ids=str,
)
def test_what_is_no_discrepancy_is_one_line_and_counted(
    attributes: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    good = {"kind": "phantom", "east_m": "1", "north_m": "2", "radius_m": "0.5", "cells": "9", "frame_id": "odom"}
    site, _robot = a_pair()
    object_id = "/scene/yard/discrepancy/1@mallory"
    said = {**good, **attributes} if attributes else {}
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            site.node.changed(told(object_id, "mallory", None, ObjectKind.DISCREPANCY, said))
    assert site.node.discrepancies() == () and site.node.unused == {Unused.UNREADABLE: 3}
    assert len(caplog.records) == 1 and object_id in caplog.text
    site.node.changed(told(object_id, "mallory", None, ObjectKind.DISCREPANCY, good))
    assert [each.radius_m for each in site.node.discrepancies()] == [0.5]


def test_another_site_can_tell_of_so_many() -> None:
    site, _robot = a_pair()
    good = {"kind": "phantom", "east_m": "1", "north_m": "2", "radius_m": "0.5", "cells": "9"}
    for number in range(MOST_OF_OTHERS + 5):
        object_id = f"/scene/yard/discrepancy/{number}@mallory"
        site.node.changed(told(object_id, "mallory", None, ObjectKind.DISCREPANCY, good))
    site.node.changed(told("/scene/field/discrepancy/1@mallory", "mallory", None, ObjectKind.DISCREPANCY, good))
    assert len(site.node.discrepancies()) == MOST_OF_OTHERS and site.node.unused == {Unused.FULL: 5}
    site.now += 1.0
    site.turn()
    assert len(markers(site)) == 2 * MOST_OF_OTHERS
    for number in range(MOST_OF_OTHERS):
        site.node.deleted(f"/scene/yard/discrepancy/{number}@mallory")
    assert site.node.discrepancies() == ()


def test_a_localisation_that_is_off_makes_no_discrepancies_of_what_is_there() -> None:
    """A wall all around that the map has, seen from poses that are off by 2 cm and half a degree, for a minute."""
    random = np.random.default_rng(3)
    cells = np.full(GRID.shape, FREE, np.int8)
    distances = np.hypot(*GRID.centres(*np.indices(GRID.shape)).transpose(2, 0, 1))
    cells[np.abs(distances - 4.05) < 0.15] = OCCUPIED
    site, robot = a_pair(base=cells)
    site.turn()
    for _ in range(600):
        robot.now += 0.1
        x_m, y_m = random.normal(0.0, 0.02, 2)
        robot.odometry(float(x_m), float(y_m), float(random.normal(0.0, math.radians(0.5))), 1.0 + robot.now)
        robot.scan(around(9.0, 9.0, 0.1, beams=360), 1.0 + robot.now)
        robot.turn()
        assert robot.node.discrepancies() == ()


def test_what_flickers_is_one_discrepancy_and_ends_once() -> None:
    """A thing at the edge of what is seen: found and not found, scan by scan."""
    site, robot = a_pair()
    site.marker(x_m=2.0, y_m=0.0, size_m=0.6)
    site.turn()
    said: list[tuple[str, str]] = []
    robot.air.put = lambda _client, object_id, kind, *_more: (  # type: ignore[method-assign]
        said.append(("put", object_id)) if kind is ObjectKind.DISCREPANCY else None
    )
    robot.air.delete = lambda client, object_id: said.append(("delete", object_id))  # type: ignore[method-assign]
    there, gone = robot.node.twin_cells(), np.full(GRID.shape, -1, np.int8)
    for step in range(40):
        robot.node.twin_cells = lambda step=step: gone if step % 6 == 5 else there  # type: ignore[method-assign, misc]
        drive(robot, around(9.0, 9.0, 0.1))
    robot.node.twin_cells = lambda: gone  # type: ignore[method-assign]
    drive(robot, around(9.0, 9.0, 0.1), scans=10)
    assert {object_id for _what, object_id in said} == {"/scene/yard/discrepancy/1@robot"}
    assert [what for what, _id in said if what == "delete"] == ["delete"] and said[-1][0] == "delete"
