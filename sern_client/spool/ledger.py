"""What a site has of which stream, on disk, so that its next process does not ask for it again."""

import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from sern_core.site.runs import Run
from sern_core.vocabulary.types import TopicName

FILE: Final = "ledger.json"
VERSION: Final = 1

_log = logging.getLogger(__name__)

Ledger = Mapping[TopicName, Mapping[int, tuple[Run, ...]]]
"""By topic and boot number, the runs of seqs that are recorded."""


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
    path = directory / FILE
    made = path.with_name(f"{FILE}.new")
    topics = {topic: {str(boot): runs for boot, runs in boots.items()} for topic, boots in ledger.items()}
    with made.open("w", encoding="utf-8") as file:
        json.dump({"version": VERSION, "topics": topics}, file)
        file.flush()
        os.fsync(file.fileno())
    made.replace(path)
