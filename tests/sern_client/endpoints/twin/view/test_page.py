"""The page of the view: what stands on it, and what a browser shows of it."""

import asyncio
import io
import math
import socket
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from benchmarks.twin_picture import CLOSE_NOTE, World
from sern_client.endpoints.twin.options import ViewOptions
from sern_client.endpoints.twin.view.frames import Snapshot
from sern_client.endpoints.twin.view.server import TwinView
from sern_core.vocabulary.errors import ConfigError
from sern_tools.harness.browser import Tab, browser, opened
from sern_twin.world.discrepancy import DiscrepancyKind, SeenDiscrepancy
from tests.support import Events, Patience, until

viser = pytest.importorskip("viser", reason="needs viser: pip install 'sern[viz]'")

ANYWHERE = ViewOptions("127.0.0.1", 0)
PANEL_PX = 330
"""At the right: what stands beside the scene."""
Pixels = NDArray[np.int64]


def view_of(world: World) -> TwinView:
    view = world.endpoint.view
    assert view is not None
    return view


async def test_an_address_that_is_taken_or_not_ours_is_one_line() -> None:
    """viser itself would take another port, or wait for ever."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        view = TwinView(ViewOptions("127.0.0.1", port), (), World().endpoint.snapshot, now=lambda: 0.0)
        with pytest.raises(ConfigError, match=f"127.0.0.1:{port}: Address already in use: choose another address"):
            await view.start()
        await view.stop()
    elsewhere = TwinView(ViewOptions("192.0.2.1", 8090), (), World().endpoint.snapshot, now=lambda: 0.0)
    with pytest.raises(ConfigError, match=r"192\.0\.2\.1:8090: Cannot assign requested address"):
        await elsewhere.start()


async def test_without_a_browser_nothing_is_drawn_but_kept(capfd: pytest.CaptureFixture[str]) -> None:
    world = World(ANYWHERE)
    await world.endpoint.start(Events())
    view = view_of(world)
    try:
        await until(lambda: len(view.history) == 1, "a snapshot is kept")
        assert view.page is not None and not view.page.watched
        world.play(3.0, 0.0)
        assert len(view.history) == 16
    finally:
        await world.endpoint.stop()
    assert view.failures == 0
    assert capfd.readouterr().out == "", "viser prints nothing"


async def test_a_view_that_fails_is_said_and_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    """The twins do not depend on who looks at them."""
    world = World()
    calls = 0

    def look() -> Snapshot:
        nonlocal calls
        calls += 1
        if calls == 1:
            raise ValueError("no such thing")
        return world.endpoint.snapshot()

    view = TwinView(ANYWHERE, (), look, now=lambda: 0.0)
    await view.start()
    try:
        await until(lambda: len(view.history) == 1)
    finally:
        await view.stop()
    assert view.failures == 1
    assert "the view of the twins failed, and goes on: no such thing" in caplog.text


def test_what_others_chose_the_words_of_is_text() -> None:
    from sern_client.endpoints.twin.view.page import Picture, link_html, table_html

    world = World()
    world.play(1.0, 0.0)
    world.endpoint.show_link(lambda: "<img src=x onerror=alert(1)> is gone")
    snapshot = world.endpoint.snapshot()
    assert "<img" not in link_html(Picture(snapshot, 0.0, 10.0)) and "&lt;img" in link_html(Picture(snapshot, 0.0, 10))
    assert "12 s ago" in link_html(Picture(snapshot, 12.0, 30.0))
    said = table_html(snapshot)
    assert "jackal1" in said and "0.00 s old, error at most 0.02 m" in said
    wrong = SeenDiscrepancy("a", "<b>robot", DiscrepancyKind.PHANTOM, 1.26, 2.0, 0.5, 9)
    said = table_html(snapshot, (wrong,) * 12)
    assert said.count("phantom: &lt;b&gt;robot sees nothing there (1.3, 2.0) m") == 10 and "and 2 more" in said


def where(red: int, green: int, blue: int) -> Callable[[Pixels], NDArray[np.int64]]:
    """Rows and columns, (n, 2), of pixels of about the direction of a colour, however it is lit, and no grey."""
    wanted = np.array([red, green, blue], np.float64)
    wanted -= wanted.mean()

    def found(pixels: Pixels) -> NDArray[np.int64]:
        strange = pixels - pixels.mean(axis=-1, keepdims=True)
        strength = np.linalg.norm(strange, axis=-1)
        along = strange @ wanted / (np.maximum(strength, 1e-9) * np.linalg.norm(wanted))
        return np.argwhere((strength > 40) & (along > math.cos(0.35)))

    return found


BLUE, PINK, AMBER = where(37, 99, 235), where(192, 38, 211), where(245, 190, 60)
"""Of both robots, and of the bound of one that is silent."""


async def seen(tab: Tab, condition: Callable[[Pixels], bool], what: str) -> Pixels:
    """The scene in the browser, once it is as it should be."""
    patience = Patience(60.0)
    while True:
        with Image.open(io.BytesIO(await tab.picture())) as image:
            pixels = np.asarray(image.convert("RGB"), np.int64)[:, :-PANEL_PX]
        await tab.ask("Runtime.evaluate", expression=CLOSE_NOTE)  # it is orange, too
        if condition(pixels):
            return pixels
        assert not patience.over(), (
            f"{what}: {len(BLUE(pixels))} blue, {len(PINK(pixels))} pink, {len(AMBER(pixels))} amber pixels"
        )
        await asyncio.sleep(0.1)


@pytest.mark.skipif(browser() is None, reason="needs chromium")
async def test_a_browser_shows_the_twins_as_they_are_and_were(tmp_path: Path) -> None:
    world = World(ANYWHERE)
    world.play(12.0, 12.0)
    await world.endpoint.start(Events())
    view = view_of(world)
    page = view.page
    assert page is not None
    try:
        async with opened(page.url, tmp_path, width=1000, height=600) as tab:
            await until(lambda: page.watched, "the browser is there", deadline_s=60.0)
            now = await seen(
                tab,
                lambda each: len(BLUE(each)) > 150 and len(PINK(each)) > 150 and len(AMBER(each)) > 100,
                "both twins, and a bound",
            )
            page.slider.value = 13.0  # type: ignore[misc]
            then = await seen(
                tab,
                lambda each: len(BLUE(each)) > 150 and len(AMBER(each)) < 20,
                "before the silence, without a bound to see",
            )
            moved_px = np.linalg.norm(BLUE(now).mean(axis=0) - BLUE(then).mean(axis=0))
            assert moved_px > 30, "the twin was elsewhere"
            page.live()
            await seen(tab, lambda each: len(AMBER(each)) > 100, "now again")
            page.follow.value = "jackal2"  # type: ignore[misc]
            await seen(tab, lambda each: np.abs(PINK(each).mean(axis=0) - (300, 500)).max() < 60, "it is followed")
        await until(lambda: not page.watched, "the browser has gone", deadline_s=60.0)
    finally:
        await world.endpoint.stop()
    assert view.failures == 0
