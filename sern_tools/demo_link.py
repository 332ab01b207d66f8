"""The demo's hand on its proxy: start the script, read what was carried."""

import asyncio
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sern_core.vocabulary.errors import SernError
from sern_tools.demo_report import Carried
from sern_tools.demo_scenario import FAR_HOST
from sern_tools.harness.processes import Child, Children, python
from sern_tools.proxy import address

HOST: Final = "127.0.0.1"


@dataclass
class LinkProcess:
    """A shaping proxy in a process of its own; `ports` are where it listens, one for each target."""

    child: Child
    ports: list[int]
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    @classmethod
    async def start(
        cls,
        children: Children,
        name: str,
        targets: list[int],
        *,
        profile: str,
        profiles: Path | None,
        seed: int,
        datagrams: bool = False,
    ) -> "LinkProcess":
        """Start it; with `datagrams` it listens on `FAR_HOST`, TCP and UDP, on the very ports of its targets: a relay
        tells its clients the number of its UDP port, and not where a proxy has it."""
        command = python("-m", "sern_tools.proxy", "--profile", profile, "--seed", str(seed))
        for port in targets:
            listen = f"{FAR_HOST}:{port}" if datagrams else f"{HOST}:0"
            command += ["--listen", listen, "--target", f"{HOST}:{port}"]
        if datagrams:
            command.append("--udp")
        if profiles is not None:
            command += ["--profiles", str(profiles)]
        child = await children.start(name, command, talks=True)
        ready = await child.read_object()
        reader, writer = await asyncio.open_connection(HOST, ready["control"], limit=2**24)
        return cls(child, [address(text)[1] for text in ready["listening"]], reader, writer)

    async def ask(self, **request: object) -> dict[str, Any]:
        """SernError when the proxy is gone or refuses."""
        try:
            self.writer.write(json.dumps(request).encode() + b"\n")
            await self.writer.drain()
            line = await self.reader.readline()
        except ConnectionError:
            line = b""
        if not line:
            raise self.child.failure()
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise SernError(f"the proxy refused {request}: {answer['error']}")
        return answer

    async def carried(self) -> Carried:
        """What went from robot to site so far."""
        statistics = await self.ask(do="stats")
        return Carried(statistics["bucket_s"], statistics["up"]["bytes_per_bucket"])

    def close(self) -> None:
        self.writer.close()
