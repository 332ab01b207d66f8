"""Photographs Foxglove Studio at a site for the documents:
`python -m tests.peers.foxglove.viewer.picture docs/images/foxglove.png`, after `tests/peers/foxglove/viewer/setup`.

A relay, a simulated robot and a site, whose link is slow and gone for 5 s; the layout is the one in deploy/examples.
"""

import argparse
import asyncio
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Final

from PIL import Image
from ruamel.yaml import YAML

from sern_core.vocabulary.errors import SernError
from sern_sim.models import LinkModel, Window
from sern_tools.ports import free_ports
from sern_tools.proxy import Route, ShapingProxy
from tests.daemons import HOST, Json, Lab
from tests.peers.foxglove.viewer.studio import HERE, missing, studio

EXAMPLES: Final = HERE.parents[3] / "deploy" / "examples"
COLOURS: Final = 256
TOPICS: Final = (
    "/odometry/filtered", "/pose", "/tf", "/tf_static", "/scan", "/points", "/map", "/path", "/battery", "/imu/data",
    "/camera/image_raw",
)  # fmt: skip
ROBOT: Final[Json] = {
    "kind": "synthetic", "role": "robot", "encoding": "cdr", "seed": 3, "patrol": True, "topics": list(TOPICS),
    "cloud_bytes": 30_000, "cloud_rate_hz": 5.0,
}  # fmt: skip
LINK: Final = LinkModel(rate_bps=4e6, delay_s=0.04, overhead_bytes=28, blackouts=(Window(11.0, 16.0),))
FAR_HOST: Final = "127.0.0.2"
"""Where the far end of the link is."""
SHOWN_S: Final = 23.0
ONBOARDING: Final = "document.querySelector('.MuiTooltip-popper button')"


def example(name: str) -> Json:
    content: Json = YAML(typ="safe").load((EXAMPLES / name).read_text())
    return content


async def photograph(out: Path, directory: Path) -> None:
    (port,) = free_ports(1)
    lab = Lab(directory, "jackal1", "site1")
    routes = [Route((FAR_HOST, lab.port), (HOST, lab.port))]
    async with lab, ShapingProxy(LINK, LINK, routes, seed=1, datagrams=True) as proxy:
        lab.process(lab.relay_file())
        lab.process(lab.client_file("jackal1", ROBOT, topics=example("robot.yaml")["topics"]))
        shipped = example("site-foxglove.yaml")
        site = lab.client_file(
            "site1",
            shipped["endpoint"] | {"listen": f"{HOST}:{port}"},
            client={"namespace": "/"},
            relay={"endpoint": f"tcp://{FAR_HOST}:{lab.port}"},
            on_demand=["/.*"],
            topics=shipped["topics"],
        )
        await lab.process(site).ready()
        layouts = {"jackal1": json.loads((EXAMPLES / "foxglove-layout.json").read_text())}
        (profile := directory / "profile").mkdir()
        async with studio(f"ws://{HOST}:{port}", layouts, profile, layout="jackal1") as viewer:
            await viewer.until_said("Hz")
            proxy.start()
            await viewer.click(ONBOARDING)
            await asyncio.sleep(SHOWN_S)
            picture = await viewer.picture()
    with Image.open(io.BytesIO(picture)) as image:
        image.convert("RGB").quantize(COLOURS).save(out, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Photograph Foxglove Studio at a site.")
    parser.add_argument("out", type=Path, help="the PNG to write")
    out = parser.parse_args().out
    if (problem := missing()) is not None:
        sys.exit(f"picture: {problem}")
    with tempfile.TemporaryDirectory() as directory:
        try:
            asyncio.run(photograph(out, Path(directory)))
        except (SernError, OSError) as error:
            sys.exit(f"picture: {error}")


if __name__ == "__main__":
    main()
