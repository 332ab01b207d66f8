"""Store and forward in a client's file: what is kept here, and what is fetched from others."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from pydantic import model_validator

from sern_core.topics.patterns import PatternError, compile_pattern
from sern_core.topics.spool_names import robot_patterns, site_patterns
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.base import Bytes, FileProblem, PathText, Pattern, Section, fault, pattern_problems, resolve
from sern_runtime.config.shared import output_problems
from sern_runtime.config.yaml import Loc

MIN_BYTES: Final = 2**20
DIRECTORY: Final[Loc] = ("spool", "directory")


class SpoolSection(Section):
    """Messages that are kept in files, whether they are sent or not, and fetched later (docs/spool.md)."""

    directory: PathText
    """A directory for it alone, made if it is not there. Each client needs its own."""
    max_bytes: Bytes = 4 * 2**30
    """Bytes of what is kept here at most; then the oldest file goes. And of what is fetched: then no more is."""
    topics: tuple[Pattern, ...] = ()
    """Regular expressions for whole local names: of these topics everything is kept."""
    fetch: tuple[Pattern, ...] = ()
    """Regular expressions for whole global names: of these topics of others what is missing here is fetched."""
    automatic: bool = True
    """Fetch whatever is missing while the link has nothing else to do; false: only what `sern spool fetch` asks for."""

    @model_validator(mode="after")
    def _says_what(self) -> "SpoolSection":
        if not self.topics and not self.fetch:
            raise fault("keeps nothing and fetches nothing; name topics in `topics` (a robot) or `fetch` (a site)")
        if self.max_bytes < MIN_BYTES:
            raise fault(f"is too small for 16 files; give at least {MIN_BYTES}", "max_bytes")
        for index, text in enumerate(self.fetch):
            try:
                compile_pattern(site_patterns(ClientName("x" * 63), (text,))[1])
            except PatternError as error:
                raise fault(str(error), "fetch", index) from error
        return self

    def subscriptions(self, client: ClientName, namespace: str) -> tuple[str, ...]:
        """What to ask the relay for."""
        kept = robot_patterns(namespace) if self.topics else ()
        return (*kept, *site_patterns(client, self.fetch))

    def problems(self, base_dir: Path) -> Iterator[FileProblem]:
        """Problems of the directory, and patterns that match no name."""
        directory = resolve(base_dir, self.directory)
        probe = directory / "spool.lock" if directory.is_dir() else directory
        yield from output_problems(base_dir, str(probe), DIRECTORY)
        yield from pattern_problems(self.topics, ("spool", "topics"))
        yield from pattern_problems(self.fetch, ("spool", "fetch"))
