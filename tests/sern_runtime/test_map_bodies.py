"""The robot's own map as messages: whole, and what changes in it."""

import math

import numpy as np
import pytest

from sern_core.vocabulary.types import Encoding
from sern_navigation.mapping import Mapper
from sern_navigation.scan import ObstacleScan, ScanOptions, planar_scan
from sern_runtime import ros_types
from sern_runtime.map_bodies import GRID, UPDATE, MapWriter
from sern_twin.world.grid import Grid
from sern_twin.world.map_updates import MapUpdates
from sern_twin.world.patches import Cells

MAP = Grid(-3.0, -2.0, 0.1, 60, 40, frame_id="map")


@pytest.mark.parametrize("encoding", [Encoding.CDR, Encoding.ROS1])
def test_a_map_that_a_robot_makes_is_the_same_for_who_reads_its_messages(encoding: Encoding) -> None:
    mapper, updates, writer = Mapper(MAP), MapUpdates(MAP), MapWriter(MAP, encoding)
    bearings = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    theirs: Cells = np.zeros((0, 0), np.int8)
    sizes = []
    for step in range(30):
        ranges = np.full(360, 1.5 if step < 12 else 1.8)
        scan = planar_scan(ranges, bearings, 0.1 * step, ScanOptions())
        assert isinstance(scan, ObstacleScan)
        mapper.add((0.0, 0.0, 0.0), scan)
        due = updates.due(mapper.occupancy.classes(), 0.1 * step)
        if isinstance(due, tuple):
            for update in due:
                body = writer.update(update, stamp_ns=step)
                sizes.append(len(body))
                message = ros_types.deserialise(body, UPDATE, encoding)
                cells = np.asarray(message.data, np.int8).reshape(message.height, message.width)
                theirs[message.y : message.y + message.height, message.x : message.x + message.width] = cells
        else:
            message = ros_types.deserialise(writer.whole(due, stamp_ns=step), GRID, encoding)
            assert (message.info.width, message.info.height, message.header.frame_id) == (60, 40, "map")
            assert message.info.resolution == pytest.approx(0.1)
            place = message.info.origin.position
            assert (place.x, place.y, message.info.origin.orientation.w) == pytest.approx((-3.0, -2.0, 1.0))
            theirs = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
    assert np.array_equal(theirs, mapper.occupancy.classes())
    assert {-1, 0, 100} == set(np.unique(theirs).tolist())
    assert 10 < len(sizes) < 150 and max(sizes) < 400, "a block and its header"
