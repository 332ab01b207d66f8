"""Store and forward of one client: what keeps, what serves, what fetches, as its file says."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sern_client.endpoints.base import KeepingEndpoint, keepers_of
from sern_client.site import Site
from sern_client.spool.fetching import SpoolFetching
from sern_client.spool.keeping import Taps
from sern_client.spool.serving import SpoolServing
from sern_core.site.client import ClientCore
from sern_core.topics.patterns import compile_pattern
from sern_core.topics.spool_names import SpoolStream, SpoolStreamKind
from sern_core.topics.spool_names import parse as parse_spooled
from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.message import Message, StreamInfo
from sern_runtime.config.spool import SpoolSection
from sern_runtime.spool.files import Kept
from sern_runtime.spool.keeper import SpoolKeeper
from sern_runtime.spool.store import Store

KEPT: Final = "spool"
FETCHED: Final = "filled"
"""How the files of what is kept here begin, and of what was fetched."""


class Spool:
    """`start` once the loop runs and before the endpoint does, `look` about twice a second, then `close`."""

    def __init__(self, core: ClientCore, site: Site, section: SpoolSection, directory: Path) -> None:
        self.directory = directory
        self.max_bytes = section.max_bytes
        self.keeper = self._keeper(KEPT, keeps_all=False) if section.topics else None
        """What keeps this site's own topics; None: it keeps none."""
        self.filler = self._keeper(FETCHED, keeps_all=True) if section.fetch else None
        """What writes what was fetched; None: nothing is."""
        self.taps: Taps | None = None
        self.serving: SpoolServing | None = None
        self.fetching: SpoolFetching | None = None
        if self.keeper is not None:
            patterns = tuple(compile_pattern(text) for text in section.topics)
            self.taps = Taps(core, patterns, self.keeper.put)
            self.serving = SpoolServing(core, self.keeper, site.kick)
        if self.filler is not None:
            keepers: list[KeepingEndpoint] = list(keepers_of(site.endpoint))
            patterns = tuple(compile_pattern(text) for text in section.fetch)
            self.fetching = SpoolFetching(
                core, site, self.filler, topics=patterns, automatic=section.automatic, keepers=keepers
            )

    def _keeper(self, prefix: str, *, keeps_all: bool) -> SpoolKeeper:
        store = Store(self.directory, prefix, max_bytes=self.max_bytes, keeps_all=keeps_all)
        call_soon = asyncio.get_running_loop().call_soon_threadsafe
        return SpoolKeeper(store, call_soon=call_soon, on_kept=self._filled if keeps_all else None)

    def _filled(self, messages: Sequence[Kept], safe: bool) -> None:
        if self.fetching is not None:
            self.fetching.kept(messages, safe)

    def start(self) -> None:
        """Raises ConfigError where the directory cannot be used."""
        for keeper in (self.keeper, self.filler):
            if keeper is not None:
                keeper.start()
        if self.fetching is not None:
            self.fetching.start()

    def look(self) -> None:
        if self.serving is not None:
            self.serving.look()
        if self.fetching is not None:
            self.fetching.look()

    async def close(self) -> None:
        """Have everything on disk that was taken. Idempotent."""
        if self.serving is not None:
            self.serving.close()
        for keeper in (self.keeper, self.filler):
            if keeper is not None:
                await asyncio.get_running_loop().run_in_executor(None, keeper.close)
        await asyncio.sleep(0)  # what the thread has told last
        if self.fetching is not None:
            await self.fetching.close()

    # --- from the link ----------------------------------------------------------------------------------------------

    def stream_opened(self, stream: StreamInfo, parts: SpoolStream) -> None:
        """ConfigError where it is nothing for this site."""
        if parts.kind is SpoolStreamKind.FETCH and self.serving is not None:
            self.serving.stream_opened(stream, parts)
        elif parts.kind is not SpoolStreamKind.FETCH and self.fetching is not None:
            self.fetching.stream_opened(stream, parts)
        else:
            raise ConfigError(f"{stream.id.topic} is nothing for this site; see `spool` in its file")

    def stream_closed(self, stream: StreamInfo) -> None:
        if self.serving is not None:
            self.serving.stream_closed(stream)
        if self.fetching is not None:
            self.fetching.stream_closed(stream)

    def message(self, stream: StreamInfo, message: Message) -> bool:
        """False: it is no message of store and forward."""
        parts = parse_spooled(stream.id.topic)
        if parts is None:
            return False
        if parts.kind is SpoolStreamKind.FETCH and self.serving is not None:
            return self.serving.message(stream, message)
        if self.fetching is not None:
            self.fetching.message(stream, message, parts)
        return True

    def expired(self, stream: StreamInfo) -> None:
        """Messages of a stream were lost on their way."""
        if self.fetching is not None:
            self.fetching.expired(stream)

    # --- for people -------------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str | None:
        """Why something is not kept at the moment."""
        problems = (keeper.problem for keeper in (self.keeper, self.filler) if keeper is not None)
        return next(filter(None, problems), None)

    def in_brief(self) -> dict[str, object]:
        """What `/api/link` says of it: what is wrong, what a robot has kept, what a site still lacks, by topic."""
        keeper, fetching = self.keeper, self.fetching
        spans = [] if keeper is None else [span for each in keeper.topics.values() for span in each]
        lacking = {} if fetching is None else fetching.missing()
        return {
            "problem": self.problem,
            "kept_messages": sum(span.messages for span in spans),
            "kept_bytes": 0 if keeper is None else keeper.store.kept_bytes,
            "missing": {topic: missing.messages for topic, missing in lacking.items() if missing.messages},
        }

    def to_json(self) -> dict[str, object]:
        """What `/api/spool` says."""
        keeper, filler = self.keeper, self.filler
        kept = [] if keeper is None else [
            {
                "topic": topic,
                "messages": sum(span.messages for span in spans),
                "bytes": sum(span.nbytes for span in spans),
                "first_ns": min(span.first_ns for span in spans),
                "last_ns": max(span.last_ns for span in spans),
            }
            for topic, spans in keeper.topics.items()
        ]  # fmt: skip
        return {
            "directory": str(self.directory.absolute()),
            "max_bytes": self.max_bytes,
            "keeps": keeper is not None,
            "fetches": filler is not None,
            "kept_bytes": 0 if keeper is None else keeper.store.kept_bytes,
            "filled_bytes": 0 if filler is None else filler.store.kept_bytes,
            "problem": self.problem,
            "kept": kept,
            **({"fetch": [], "orders": [], "automatic": False} if self.fetching is None else self.fetching.to_json()),
        }
