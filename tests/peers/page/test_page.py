"""The page in a real browser: what a person reads, that names stay text, and that it fits a phone and a laptop."""

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from sern_tools.harness.browser import NAMES, browser, opened
from tests.daemons import Lab
from tests.peers.foxglove.viewer.studio import Viewer
from tests.sern_runtime.watching.fakes import FakeTold, client_row, look, received_row
from tests.sern_runtime.watching.test_live import HOSTILE, TOKEN, fleet, served

pytestmark = pytest.mark.skipif(browser() is None, reason=f"needs {NAMES[0]}: install Debian's package of that name")

PHONE: Final = (390, 844)
LAPTOP: Final = (1280, 800)
ROBOT: Final = {"kind": "synthetic", "role": "robot", "topics": ["/odometry/filtered", "/points"]}
SHIFTS: Final = """
  window.shifts = [];
  new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) if (!entry.hadRecentInput) window.shifts.push(entry.value);
  }).observe({ type: "layout-shift", buffered: true });
"""
FITS: Final = "document.documentElement.scrollWidth <= window.innerWidth"
FRAMES: Final = 6


@asynccontextmanager
async def looked_at(url: str, directory: Path, size: tuple[int, int] = LAPTOP) -> AsyncIterator[Viewer]:
    directory.mkdir(exist_ok=True)
    async with opened(url, directory, width=size[0], height=size[1]) as tab:
        yield Viewer(tab)


async def shown(viewer: Viewer) -> None:
    await viewer.until("document.getElementById('all')?.hidden === false", "the page shows something")


def verdict(words: str) -> str:
    return f"document.getElementById('verdict').textContent.includes({json.dumps(words)})"


async def test_a_person_sees_that_all_is_well_and_then_who_is_gone(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "site") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.process(lab.client_file("robot1", ROBOT)).ready()
        await lab.process(lab.recorder_file("site", "/robot1/odometry.*")).ready()
        async with looked_at(f"http://127.0.0.1:{relay.port}/", tmp_path / "profile") as viewer:
            await viewer.until_said("robot1", "/robot1/odometry/filtered", "RTT", "nobody subscribes to it")
            await viewer.until(verdict("All is well: 2 of 2 connected"), "all is well")
            await viewer.until("document.querySelector('svg .line')?.getAttribute('d')", "a picture is drawn")
            robot.kill()
            await viewer.until(verdict("robot1 "), "it says who")
            await viewer.until("document.querySelector('#alerts .bad') !== null", "it says so in red")
            await viewer.until_said("robot1 is gone")


async def test_names_from_the_wire_stay_text_whatever_they_are(tmp_path: Path) -> None:
    told = FakeTold([client_row("<b>robot</b>", "away", why="<script>window.pwned = 1</script>")])
    told.clients_told.append(client_row("robot0\u202egnp.exe"))
    told.topics_told[HOSTILE] = ("robot0", received_row(5, dropped={"<svg onload=alert(2)>": 3}))
    told.topics_told["/__proto__"] = ("robot0", received_row(5))
    told.looked = [look("__proto__"), look("<b>robot</b>")]
    told.kinds = ["<i>kind</i>"]
    async with served(told) as page:
        page.events.add("connected", "x", "<img src=x onerror=alert(3)> came")
        markup = "document.querySelectorAll('#all img, #all script, #all b b, #all i:not(.key)').length"
        async with looked_at(page.url, tmp_path / "profile") as viewer:
            await viewer.until_said(
                HOSTILE, "<b>robot</b>", "<svg onload=alert(2)>", "<i>kind</i>", "<img src=x onerror"
            )
            assert await viewer.ask(markup) == 0
            assert await viewer.ask("window.pwned === undefined && ({}).number === undefined") is True
            assert "\u202e" not in await viewer.text(), "nothing turns the reading direction round"
            blocked = "(() => { try { document.body.innerHTML = '<p>'; return false; } catch { return true; } })()"
            assert await viewer.ask(blocked) is True, "markup out of text is refused by the browser itself"


@pytest.mark.parametrize("size", [PHONE, LAPTOP], ids=["phone", "laptop"])
@pytest.mark.parametrize("robots", [0, 50])
async def test_it_fits_with_none_and_with_fifty_robots_and_nothing_jumps(
    tmp_path: Path, size: tuple[int, int], robots: int
) -> None:
    told = fleet(robots, 1000) if robots else FakeTold()
    for number in range(0, robots, 10):
        told.clients_told[number] |= {
            "state": "away",
            "why": "its connection is gone and no datagram came for 6 s",
            "lane": None,
        }
    if robots:
        long = "/robot0/" + "a_long_name_without_any_place_to_break_it" * 4
        told.topics_told[long] = ("robot0", received_row(3))
    async with served(told) as page:
        page.live.history.step_s = 0.2
        async with looked_at(page.url, tmp_path / "profile", size) as viewer:
            await viewer.ask(SHIFTS)
            await shown(viewer)
            assert await viewer.ask(FITS), "nothing is wider than the window"
            words = "robot0 is gone for 12 s; 4 more" if robots else "Nobody is connected yet"
            await viewer.until(verdict(words), "the first line says it")
            await viewer.ask("window.shifts.length = 0")
            for _ in range(FRAMES):
                number = page.live.number
                for _owner, row in told.topics_told.values():
                    row["delivered"] += 7
                    row["bytes_delivered"] += 7000
                seen = page.live.number
                while page.live.number <= number + 1:
                    await viewer.ask("new Promise(requestAnimationFrame).then(() => true)")
                assert page.live.number > seen
            assert await viewer.ask("window.shifts.reduce((sum, each) => sum + each, 0)") < 0.01
            assert await viewer.ask(FITS)
            if robots:
                await viewer.ask("document.getElementById('links-more').click()")
                await viewer.until("document.querySelectorAll('#links > li').length === 50", "all of them are shown")
                await viewer.ask("document.getElementById('filter').value = 'robot7/'")
                await viewer.ask("document.getElementById('filter').dispatchEvent(new Event('input'))")
                await viewer.until("document.querySelectorAll('#topics > li').length >= 1", "some are found")
                names = "[...document.querySelectorAll('#topics .topic')].map((each) => each.innerText)"
                assert await viewer.ask(f"{names}.every((name) => name.includes('robot7/'))")


async def test_the_token_is_asked_for_once_and_stands_in_no_address(tmp_path: Path) -> None:
    async with served(fleet(1, 1), token=TOKEN) as page, looked_at(page.url, tmp_path / "profile") as viewer:

        async def give(token: str) -> None:
            await viewer.until("document.getElementById('ask')?.hidden === false", "it asks")
            await viewer.ask(f"document.getElementById('token').value = {json.dumps(token)}")
            await viewer.click("document.querySelector('#ask button')")

        await give("fedcba9876543210")
        await viewer.until_said("This is not the token.")
        await give(TOKEN)
        await shown(viewer)
        assert await viewer.ask("sessionStorage.length") == 1
        assert await viewer.ask("localStorage.length + document.cookie.length") == 0
        addresses = "[location.href, ...performance.getEntries().map((each) => each.name)].join(' ')"
        assert TOKEN not in await viewer.ask(addresses)
        await viewer.ask("location.reload()")
        await viewer.until("document.readyState === 'complete'", "it is loaded again")
        await shown(viewer)


async def test_what_is_shown_is_not_taken_for_now_when_the_daemon_is_gone(tmp_path: Path) -> None:
    async with looked_at("about:blank", tmp_path / "profile") as viewer:
        async with served(fleet(1, 1)) as page:
            await viewer.ask(f"location.href = {json.dumps(page.url)}")
            await viewer.until(
                "document.getElementById('all') && !document.getElementById('all').hidden", "it is shown"
            )
        await viewer.until(verdict("No answer"), "it says that nobody answers")
        assert await viewer.ask("document.getElementById('bar').className") == "bad"
        said: Any = await viewer.text()
        assert "what follows is of 12:00:00Z" in said
