"""What a site has of which stream, on disk, so that its next process does not ask for it again."""

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from sern_core.site.runs import Run
from sern_core.vocabulary.types import TopicName
from sern_runtime.whole_file import write_whole

FILE: Final = "ledger.json"
VERSION: Final = 1

_log = logging.getLogger(__name__)

Ledger = Mapping[TopicName, Mapping[int, tuple[Run, ...]]]
"""The runs of seqs that are recorded, by topic and boot number."""


def load(directory: Path) -> Ledger:
    """Raises OSError. A file that cannot be read is put aside, and nothing is known then: what is fetched twice is
    left out when the recording is merged."""
    path = directory / FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["version"] != VERSION:
            raise ValueError(f"its version is {content['version']}")
        return {
            TopicName(topic): {
                int(boot): tuple((int(first), int(last)) for first, last in runs if 0 < int(first) <= int(last))
                for boot, runs in boots.items()
            }
            for topic, boots in content["topics"].items()
        }
    except FileNotFoundError:
        return {}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        aside = path.with_name(f"{FILE}.damaged")
        path.replace(aside)
        _log.error("%s cannot be read (%s) and is put aside as %s; what is here already may be fetched again", path,
                   error, aside)  # fmt: skip
        return {}


def save(directory: Path, ledger: Ledger) -> None:
    """Raises OSError. It is there whole, or as it was before."""
    topics = {topic: {str(boot): runs for boot, runs in boots.items()} for topic, boots in ledger.items()}
    write_whole(directory / FILE, json.dumps({"version": VERSION, "topics": topics}))
