"""Photographs the page of a relay, or of a client, for the documents:
`python -m tests.peers.page.picture docs/images/page.png`.

Robots and a site with keys, each robot behind a link of its own: one thin, one that loses packets, one gone at the end.
"""

import argparse
import asyncio
import io
import sys
import tempfile
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from PIL import Image

from sern_core.vocabulary.errors import SernError
from sern_sim.models import LinkModel, Window
from sern_tools.harness.browser import NAMES, browser, opened
from sern_tools.proxy import Route, ShapingProxy
from tests.daemons import HOST, Json, Lab
from tests.peers.foxglove.viewer.studio import Viewer

COLOURS: Final = 128
FEW: Final = 8
"""Above so many robots each sends less, so that one machine can be all of them."""
SITE: Final = "site1"
TOPICS: Final = ("/odometry/filtered", "/tf_static", "/scan", "/points", "/map", "/battery")
RULES: Final = (
    {"match": ".*odometry.*", "class": "control", "depth": 1},
    {"match": ".*points", "class": "bulk", "lifespan_s": 2.0},
    {"match": "/(map|tf_static)", "class": "state", "durability": "transient_local", "depth": 1},
)


@dataclass(frozen=True)
class Robot:
    """A robot, the link to it, and when its process ends; None: not before the picture is taken."""

    name: str
    link: LinkModel
    process_gone_s: float | None = None


def fleet(count: int, seconds: float) -> list[Robot]:
    """So many robots for a picture that is taken after `seconds`; every fourth is like another."""
    thin = LinkModel(rate_bps=8e5, delay_s=0.08, overhead_bytes=28)
    lossy = LinkModel(rate_bps=6e6, delay_s=0.03, loss=0.08, overhead_bytes=28)
    good = LinkModel(rate_bps=2e7, delay_s=0.02, overhead_bytes=28, blackouts=(Window(0.4 * seconds, 0.5 * seconds),))
    gone = LinkModel(rate_bps=4e6, delay_s=0.04, overhead_bytes=28)
    kinds = (("jackal", good), ("husky", thin), ("scout", lossy), ("rover", gone))
    robots = []
    for index in range(count):
        kind, link = kinds[index % len(kinds)]
        leaves = seconds - 15.0 if kind == "rover" and index < len(kinds) else None
        robots.append(Robot(f"{kind}{index // len(kinds) + 1}", link, leaves))
    return robots


async def photograph(options: argparse.Namespace, directory: Path) -> None:
    robots = fleet(options.robots, options.seconds)
    async with AsyncExitStack() as stack:
        lab = await stack.enter_async_context(Lab(directory, SITE, *(robot.name for robot in robots)))
        processes = {"relay": await lab.process(lab.relay_file(adaptation={"interval_s": 1.0})).ready()}
        proxies = []
        for index, robot in enumerate(robots):
            far = f"127.0.0.{2 + index}"
            route = Route((far, lab.port), (HOST, lab.port))
            proxy = ShapingProxy(robot.link, robot.link, [route], seed=index, datagrams=True)
            proxies.append(await stack.enter_async_context(proxy))
            few = options.robots <= FEW
            endpoint: Json = {
                "kind": "synthetic", "role": "robot", "seed": index, "patrol": True, "topics": list(TOPICS),
                "cloud_bytes": 20_000 if few else 4_000, "cloud_rate_hz": 5.0 if few else 1.0,
                "pose_rate_hz": 20.0 if few else 4.0,
            }  # fmt: skip
            sections: Json = {"relay": {"endpoint": f"tcp://{far}:{lab.port}"}, "topics": list(RULES)}
            if few:
                sections["adaptation"] = {"interval_s": 1.0}
            processes[robot.name] = lab.process(lab.client_file(robot.name, endpoint, **sections))
        site: Json = {"kind": "record", "path": SITE, "overwrite": True}
        wants = ["/.*/(odometry|scan|points|map|tf_static).*"]
        file = lab.client_file(SITE, site, client={"namespace": "/"}, subscribe=wants)
        processes[SITE] = lab.process(file)
        for process in processes.values():
            await process.ready()
        for proxy in proxies:
            proxy.start()
        passed_s = 0.0
        for robot in sorted(robots, key=lambda each: each.process_gone_s or options.seconds):
            if robot.process_gone_s is not None:
                await asyncio.sleep(max(0.0, robot.process_gone_s - passed_s))
                passed_s = max(passed_s, robot.process_gone_s)
                processes[robot.name].kill()
        await asyncio.sleep(max(0.0, options.seconds - passed_s))
        for number, width in enumerate(options.widths):
            (profile := directory / f"profile{number}").mkdir()
            address = f"http://{HOST}:{processes[options.daemon].port}/"
            async with opened(address, profile, width=width, height=options.height) as tab:
                scheme = {"name": "prefers-color-scheme", "value": "dark" if options.dark else "light"}
                await tab.ask("Emulation.setEmulatedMedia", features=[scheme])
                viewer = Viewer(tab)
                await viewer.until("document.getElementById('all')?.hidden === false", "the page shows something")
                await asyncio.sleep(4.0)  # rates are of three seconds
                picture = await viewer.picture()
            out = options.out if len(options.widths) == 1 else options.out.with_stem(f"{options.out.stem}-{width}")
            with Image.open(io.BytesIO(picture)) as image:
                image.convert("RGB").quantize(COLOURS).save(out, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Photograph the page of a relay.")
    parser.add_argument("out", type=Path, help="the PNG to write")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=180.0, help="after which the picture is taken")
    parser.add_argument(
        "--widths", type=int, nargs="+", default=[1280], help="of the window, in pixels; a picture each"
    )
    parser.add_argument("--height", type=int, default=800)
    parser.add_argument("--daemon", default="relay", help="whose page")
    parser.add_argument("--dark", action="store_true")
    options = parser.parse_args()
    if browser() is None:
        sys.exit(f"picture: no {NAMES[0]} on this machine: install it")
    with tempfile.TemporaryDirectory() as directory:
        try:
            asyncio.run(photograph(options, Path(directory)))
        except (SernError, OSError) as error:
            sys.exit(f"picture: {error}")


if __name__ == "__main__":
    main()
