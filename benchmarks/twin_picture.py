"""Photographs the view of the twins for the documents: `python -m benchmarks.twin_picture docs/images/twin-view.png`.

A robot drives a bend by its plan, and was last heard 8 s ago; another one is heard. Time is made, so that each picture
is the same but for how the browser draws it.
"""

import argparse
import asyncio
import io
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sern_client.endpoints.twin import bodies
from sern_client.endpoints.twin.endpoint import TwinEndpoint
from sern_client.endpoints.twin.options import FrameOrigin, RobotOptions, TwinOptions, ViewOptions
from sern_client.endpoints.twin.view.blocks import boxes
from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import Encoding
from sern_runtime import ros_types
from sern_tools.harness.browser import opened
from sern_twin.motion import Motion, Twist
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy
from sern_twin.world.grid import Grid
from sern_twin.world.patches import OCCUPIED

WIDTH: Final = 1200
HEIGHT: Final = 750
COLOURS: Final = 256
CLOSE_NOTE: Final = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(each => each.click())"
"""It closes viser's note that the drawing is done in software."""
STEP_S: Final = 0.05
LINK: Final = "connected to relay; 1 of 2 peers away: jackal1 is gone for 8 s; 84 ms there and back"
SILENT_S: Final = 8.0
RADIUS_M: Final = 9.0
WALLS: Final = ((-6.0, 18.0, 18.0, 0.5), (11.5, 4.0, 0.5, 14.0))
THINGS: Final = ((-2.0, 6.0, 1.5, 1.0), (2.5, 9.0, 1.0, 1.0), (7.5, 2.0, 1.5, 1.0))
"""East, north, width and length in metres."""
WRONG: Final = (
    SeenDiscrepancy("", "jackal2", DiscrepancyKind.PHANTOM, 8.25, 2.5, 1.0, 24),
    SeenDiscrepancy("", "jackal2", DiscrepancyKind.UNKNOWN_OBSTACLE, 4.0, 4.5, 0.6, 9),
)
ROBOTS: Final = (RobotOptions("jackal1", "/jackal1/odom", "/jackal1/plan"), RobotOptions("jackal2", "/jackal2/odom"))


def bend(time_s: float) -> Motion:
    """The motion of a robot that turns to the left at 1 m/s."""
    turned = time_s / RADIUS_M
    return Motion(
        RADIUS_M * math.sin(turned), RADIUS_M * (1 - math.cos(turned)), math.remainder(turned, 2 * math.pi),
        Twist(1.0, 0.0, 1 / RADIUS_M),
    )  # fmt: skip


def straight(time_s: float) -> Motion:
    return Motion(-6.0 + 0.5 * time_s, 2.5, 0.0, Twist(0.5))


class World:
    """The twins of two robots, in time that is made."""

    def __init__(self, view: ViewOptions | None = None, *, origin: FrameOrigin | None = None) -> None:
        self.now = 0.0
        robots = ROBOTS if origin is None else tuple(replace(each, origin=origin) for each in ROBOTS)
        self.endpoint = TwinEndpoint(TwinOptions(robots, view=view), now=lambda: self.now, wall_ns=lambda: 0)
        self.endpoint.show_link(lambda: LINK)
        self._writer = bodies.Writer(Encoding.CDR)
        self._heard: dict[str, Any] = {}

    def say(self, topic: str, type_name: str, body: bytes) -> None:
        if topic not in self._heard:
            self._heard[topic] = self.endpoint.advertise(ros_types.topic_info(topic, type_name, Encoding.CDR))
        self._heard[topic].publish(body, self._stamp_ns)

    @property
    def _stamp_ns(self) -> int:
        return round((1000.0 + self.now) * 1e9)

    def pose(self, robot: str, motion: Motion, *, z_m: float = 0.0, frame_id: str = "map") -> None:
        body = self._writer.odometry(
            motion, 0.0, z_m=z_m, stamp_ns=self._stamp_ns, frame_id=frame_id, child_frame_id="base_link"
        )
        self.say(f"/{robot}/odom", bodies.ODOMETRY, body)

    def plan(self, robot: str, end_s: float) -> None:
        times_s = np.arange(self.now, end_s, 0.5)
        stamps_ns = [round((1000.0 + float(time_s)) * 1e9) for time_s in times_s]
        body = self._writer.path(
            [bend(float(time_s)) for time_s in times_s], z_m=0.0, stamps_ns=stamps_ns, frame_id="map"
        )
        self.say(f"/{robot}/plan", bodies.PATH, body)

    def play(self, heard_s: float, silent_s: float) -> None:
        """Both are heard for a while, and then jackal2 alone."""
        self.plan("jackal1", heard_s + silent_s + 20.0)
        for step in range(round((heard_s + silent_s) / STEP_S) + 1):
            self.now = step * STEP_S
            if self.now <= heard_s:
                self.pose("jackal1", bend(self.now))
            self.pose("jackal2", straight(self.now))
            if self.endpoint.view is not None:
                self.endpoint.view.history.add(self.endpoint.snapshot())


def yard() -> tuple[Grid, np.ndarray, np.ndarray]:
    """A wall and some things that were seen, some of them just now."""
    grid = Grid(-10.0, -10.0, 0.25, 120, 120)
    cells = np.full(grid.shape, -1, np.int8)
    for x_m, y_m, wide_m, long_m in (*WALLS, *THINGS):
        row, column = (int(value) for value in grid.index([x_m, y_m]))
        cells[row : row + round(long_m / 0.25), column : column + round(wide_m / 0.25)] = OCCUPIED
    ages_s = np.full(grid.blocks, np.nan)
    for (x_m, y_m, *_), age_s in zip(THINGS, (1.0, 30.0, 500.0), strict=True):
        ages_s[grid.block_of(*grid.index([x_m, y_m]))] = age_s
    return grid, cells, ages_s


async def photograph(out: Path) -> None:
    from PIL import Image

    from sern_client.endpoints.twin.view.page import Page, Picture

    world = World()
    world.play(12.0, SILENT_S)
    page = Page(ViewOptions("127.0.0.1", 0), tuple(world.endpoint.robots))
    try:
        with tempfile.TemporaryDirectory() as profile:
            async with opened(page.url, Path(profile), width=WIDTH, height=HEIGHT) as tab:
                while not page.watched:  # noqa: ASYNC110  (its thread tells nobody)
                    await asyncio.sleep(0.1)
                page.blocks(boxes(*yard()))
                page.draw(Picture(world.endpoint.snapshot(), 0.0, 600.0, WRONG))
                before = b""
                while (picture := await tab.picture()) != before:  # until it stands still
                    before = picture
                    await tab.ask("Runtime.evaluate", expression=CLOSE_NOTE)
                    await asyncio.sleep(2.0)
        with Image.open(io.BytesIO(picture)) as image:
            image.convert("RGB").quantize(COLOURS).save(out, optimize=True)
    finally:
        page.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Photograph the view of the twins.")
    parser.add_argument("out", type=Path, help="the PNG to write")
    try:
        asyncio.run(photograph(parser.parse_args().out))
    except (SernError, OSError) as error:
        sys.exit(f"twin_picture: {error}")
