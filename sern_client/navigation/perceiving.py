"""What is in each cloud, for people and other nodes: points with their classes, and boxes of what stands in the way.

It is beside the way from cloud to command: what the robot drives by are the obstacles of `sern_navigation.scan`, which
need no class.
"""

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sern_client.endpoints.clouds import CLOUD_TYPE, cloud_body
from sern_client.endpoints.common.saying import SayOnce
from sern_core.summaries.bodies import Header
from sern_core.summaries.clouds import read_cloud
from sern_core.vocabulary.errors import BodyError
from sern_core.vocabulary.types import Encoding
from sern_perception.classes import PointClass
from sern_perception.detector import Cluster, clusters
from sern_perception.projection import VLP16, ImageShape, of_points, project
from sern_perception.segmenter import Segmenter
from sern_runtime import ros_geometry, ros_types

MARKER: Final = "visualization_msgs/msg/Marker"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"
MOST_BOXES: Final = 100
COLOURS: Final = {
    PointClass.CAR: (0.85, 0.2, 0.2), PointClass.LOG: (0.6, 0.35, 0.1), PointClass.OTHER: (0.9, 0.6, 0.1),
}  # fmt: skip
"""Red, green and blue of a box, by what most of its points are; of a thing that no class is sure of OTHER's."""
_CUBE, _ADD, _DELETE_ALL = 1, 0, 3
_log = logging.getLogger(__name__)
Publish = Callable[[str, str, bytes, int], None]
"""Name, type, body and stamp of a message."""


@dataclass(frozen=True, slots=True)
class PerceptionOptions:
    labels: str = "/perception/points"
    obstacles: str = "/perception/obstacles"
    rate_hz: float = 5.0
    shape: ImageShape = field(default_factory=lambda: VLP16)
    model: Path | None = None


class Perception:
    """`heard` takes clouds; `run` looks at the last one, so often. ConfigError: the model or its runtime is missing."""

    def __init__(self, options: PerceptionOptions, encoding: Encoding, publish: Publish) -> None:
        self._options = options
        self._encoding = encoding
        self._publish = publish
        self._segmenter = Segmenter() if options.model is None else Segmenter(options.model)
        self._last: tuple[bytes, Encoding] | None = None
        self._seq = 0
        self._said = SayOnce(_log)
        self.outcomes = dict.fromkeys(("seen", "unreadable", "left_out"), 0)
        """How many clouds came, by what became of them."""

    def heard(self, body: bytes, encoding: Encoding) -> None:
        """The newest cloud: one that was not looked at before is left out."""
        self.outcomes["left_out"] += self._last is not None
        self._last = body, encoding

    async def run(self) -> None:
        """Look at clouds in a thread, until cancelled."""
        while True:
            await asyncio.sleep(1.0 / self._options.rate_hz)
            if self._last is None:
                continue
            (body, encoding), self._last = self._last, None
            try:
                made = await asyncio.to_thread(self.look, body, encoding)
            except BodyError as error:
                self.outcomes["unreadable"] += 1
                self._said(f"perception: {error}")
                continue
            self.outcomes["seen"] += 1
            for name, type_name, out, stamp_ns in made:
                self._publish(name, type_name, out, stamp_ns)

    def look(self, body: bytes, encoding: Encoding) -> list[tuple[str, str, bytes, int]]:
        """What is published of a cloud. BodyError: it is none."""
        cloud = read_cloud(body, encoding)
        xyz = cloud.xyz().astype(np.float32)
        bright = cloud.field("intensity") is not None
        intensity = cloud.column("intensity").astype(np.float32) if bright else np.zeros(len(xyz), np.float32)
        points = np.column_stack((xyz, intensity))
        image = project(points, self._options.shape)
        classes = self._segmenter.segment(image).classes
        labels = of_points(image, classes, len(points))
        header, self._seq = cloud.header, self._seq + 1
        labelled = np.column_stack((points, labels)).astype(np.float32)
        out = cloud_body(labelled, header.stamp_ns, header.frame_id, self._encoding, self._seq)
        boxes = self._boxes(clusters(image, self._options.shape)[:MOST_BOXES], classes, header)
        return [
            (self._options.labels, CLOUD_TYPE, out, header.stamp_ns),
            (self._options.obstacles, MARKERS, boxes, header.stamp_ns),
        ]

    def _boxes(self, found: list[Cluster], classes: NDArray[np.uint8], header: Header) -> bytes:
        make = partial(
            _marker, self._encoding, ros_types.header(header.stamp_ns, header.frame_id, self._encoding, self._seq)
        )
        markers = [make(action=_DELETE_ALL)]
        for number, thing in enumerate(found):
            counts = np.bincount(classes[thing.pixels[:, 0], thing.pixels[:, 1]], minlength=len(PointClass))
            kind = PointClass(int(max(COLOURS, key=lambda each: counts[each])))
            known = counts[kind] > 0
            red, green, blue = COLOURS[kind if known else PointClass.OTHER]
            size = [max(side_m, 0.05) for side_m in thing.size_m]
            markers.append(
                make(
                    ns="obstacle",
                    id=number,
                    type=_CUBE,
                    action=_ADD,
                    pose=ros_geometry.pose(self._encoding, *thing.middle_m),
                    scale=ros_types.new("geometry_msgs/msg/Vector3", self._encoding, x=size[0], y=size[1], z=size[2]),
                    color=ros_types.new("std_msgs/msg/ColorRGBA", self._encoding, r=red, g=green, b=blue, a=0.6),
                    text=kind.name.lower() if known else "unknown",
                )
            )
        array = ros_types.new(MARKERS, self._encoding, markers=markers)
        return ros_types.serialise(array, MARKERS, self._encoding)


def _marker(encoding: Encoding, header: Any, **fields: Any) -> Any:
    return ros_types.new(MARKER, encoding, header=header, **fields)
