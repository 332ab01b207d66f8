"""The page of the view: viser's server, which runs in a thread of its own, with the scene and what stands beside it."""

import contextlib
import html
import io
import logging
import socket
import threading
from dataclasses import dataclass
from typing import Final

import numpy as np
from viser import ViserServer

from sern_client.endpoints.twin.options import ViewOptions
from sern_client.endpoints.twin.view.frames import Box, RobotFrame, Snapshot, places
from sern_client.endpoints.twin.view.history import LENGTH_S
from sern_client.endpoints.twin.view.scene import DISCREPANCY_COLOURS, LEVEL_COLOURS, ROBOT_COLOURS, Colour, Drawing
from sern_core.vocabulary.errors import ConfigError
from sern_twin.world.discrepancy import SeenDiscrepancy
from sern_twin.world.mesh import Mesh
from sern_twin.world.terrain import Terrain

NOBODY: Final = "nobody"
MOST_LINES: Final = 10
"""Discrepancies in words."""


@dataclass(frozen=True, slots=True)
class Picture:
    """What to draw: a snapshot, how long ago that is (0: now), and how far back the slider can go."""

    snapshot: Snapshot
    ago_s: float
    reaches_s: float
    discrepancies: tuple[SeenDiscrepancy, ...] = ()


class Page:
    """`close` after all else; the others in any order and by any thread, but they may take a moment: not the event
    loop's. ConfigError: the address cannot be listened on."""

    def __init__(self, options: ViewOptions, robots: tuple[str, ...]) -> None:
        self._lock = threading.Lock()
        self._closed = False
        self._server = _listen(options)
        self._server.request_share_url = _share_nothing  # type: ignore[method-assign]
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._link = gui.add_html("")
        self.slider = gui.add_slider("seconds ago", 0.0, LENGTH_S, 0.2, 0.0, hint="0: now")
        self._live = gui.add_button("live")
        self._live.on_click(lambda _event: self.live())
        self.follow = gui.add_dropdown("camera follows", (NOBODY, *robots))
        self._table = gui.add_html("")
        self._said: dict[str, str] = {}
        self.drawing = Drawing(self._server.scene)
        self._placed: set[int] = set()
        self._followed: tuple[str, np.ndarray] | None = None

    @property
    def url(self) -> str:
        host = self._server.get_host()
        return (
            f"http://[{host}]:{self._server.get_port()}" if ":" in host else f"http://{host}:{self._server.get_port()}"
        )

    @property
    def watched(self) -> bool:
        """Whether a browser is there."""
        return bool(self._server.get_clients())

    @property
    def ago_s(self) -> float:
        """Where the slider is."""
        return float(self.slider.value)

    def live(self) -> None:
        self.slider.value = 0.0  # type: ignore[misc]

    def draw(self, picture: Picture) -> None:
        with self._lock:
            if self._closed:
                return
            with self._server.atomic():
                self.drawing.draw(picture.snapshot)
                self.drawing.discrepancies(picture.discrepancies)
            self._say("link", link_html(picture))
            self._say("table", table_html(picture.snapshot, picture.discrepancies))
            self._look(picture.snapshot)

    def blocks(self, boxes: list[Box]) -> None:
        with self._lock:
            if not self._closed:
                self.drawing.blocks(boxes)

    def ground(self, mesh: Mesh, terrain: Terrain | None) -> None:
        with self._lock:
            if not self._closed and len(mesh.faces):
                self.drawing.ground(mesh, terrain)

    def close(self) -> None:
        with self._lock, contextlib.redirect_stdout(io.StringIO()):
            self._closed = True
            self._server.stop()

    def _say(self, which: str, text: str) -> None:
        if self._said.get(which) != text:
            self._said[which] = text
            (self._link if which == "link" else self._table).content = text

    def _look(self, snapshot: Snapshot) -> None:
        """Place the cameras of new browsers, and take all along with the robot that they follow."""
        clients = self._server.get_clients()
        self._placed &= clients.keys()
        camera = self.drawing.camera(snapshot)
        for number in clients.keys() - self._placed if camera is not None else ():
            assert camera is not None
            self._placed.add(number)
            clients[number].camera.position = camera.position
            clients[number].camera.look_at = camera.look_at
        name = str(self.follow.value)
        place = places(snapshot).get(name)
        if place is None:
            self._followed = None
            return
        local = self.drawing.local(place)
        there = np.array([local.x_m, local.y_m, local.z_m])
        for client in clients.values():
            begins = self._followed is None or self._followed[0] != name
            moved = there - (client.camera.look_at if begins or self._followed is None else self._followed[1])
            client.camera.position = client.camera.position + moved
        self._followed = (name, there)


def link_html(picture: Picture) -> str:
    """When that is, and how the link is; what others chose the words of is text here, and no HTML."""
    when = "now" if picture.ago_s <= 0 else f"<b>{picture.ago_s:.0f} s ago</b>"
    kept = f"kept: {picture.reaches_s:.0f} s"
    link = html.escape(picture.snapshot.link) or "nothing is known of the link"
    return f'<div style="padding:0 1em 0.8em">{when} ({kept})<br>link: {link}</div>'


def table_html(snapshot: Snapshot, discrepancies: tuple[SeenDiscrepancy, ...] = ()) -> str:
    """The promise of each robot: how old, how far off at most; and where the twin of the site is wrong."""
    lines = "".join(_line(number, robot) for number, robot in enumerate(snapshot.robots))
    for thing in discrepancies[:MOST_LINES]:
        where = f"({thing.east_m:.1f}, {thing.north_m:.1f}) m"
        lines += f"<p>{_coloured('▲', DISCREPANCY_COLOURS[thing.kind])} {html.escape(thing.says)} {where}</p>"
    if len(discrepancies) > MOST_LINES:
        lines += f"<p>and {len(discrepancies) - MOST_LINES} more</p>"
    return f'<div style="padding:0 1em;max-height:24em;overflow:auto">{lines}</div>'


def _line(number: int, robot: RobotFrame) -> str:
    name = _coloured("■", ROBOT_COLOURS[number % len(ROBOT_COLOURS)])
    level = _coloured("●", LEVEL_COLOURS[robot.level])
    frame = f" <small>({html.escape(robot.frame_id)})</small>" if robot.frame_id else ""
    return f"<p>{name} <b>{html.escape(robot.name)}</b>{frame}<br>{level} {html.escape(robot.says)}</p>"


def _coloured(text: str, colour: Colour) -> str:
    return f'<span style="color:rgb{colour}">{text}</span>'


def _share_nothing(verbose: bool = True) -> None:
    """Refuse viser's tunnel to the open Internet, for which any browser that is connected can ask."""
    del verbose


def _listen(options: ViewOptions) -> ViserServer:
    """viser takes the next port where one is taken, and waits for ever where there is no such address."""
    where = f"{options.host}:{options.port}"
    family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind((options.host, options.port))
    except OSError as error:
        raise ConfigError(f"{where}: {error.strerror}: choose another address", key="endpoint.view.listen") from error
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it says who comes and goes
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a frame around its address
        server = ViserServer(options.host, options.port, label="sern-twin", verbose=False)
        if options.port not in (0, server.get_port()):
            server.stop()
            raise ConfigError(f"{where} is taken: choose another port", key="endpoint.view.listen")
    return server
