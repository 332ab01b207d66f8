"""Whether everything is there that the steps of `make performance` need, before the first of them begins.

The steps take two hours together, and what one of them lacks would be told when the others are over. Each thing that
is missing is a line of its own; what is only made up (recordings) is said and is no failure.
"""

import argparse
import importlib.util
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from benchmarks import recordings
from benchmarks.document import DOCUMENT, DOCUMENTS, IN_README, README, insert
from sern_client.endpoints.clouds import read_ply
from sern_core.vocabulary.errors import SernError
from sern_tools.explain_replay import read_bag
from sern_tools.lab.backends import choose

STEPS: Final = ("link", "sensors", "robots", "relay", "mmcf_lab", "sync_lab", "fabric")
MODULES: Final[Mapping[str, str]] = {"psutil": "bench", "zenoh": "bench", "matplotlib": "report"}
"""The extra that each is in."""
FOLDERS: Final = ("build", "docs/images")
ROOT: Final = DOCUMENT.parents[1]


def lacking(
    document: Path = DOCUMENT, data: Path = recordings.DATA, root: Path = ROOT, readme: Path = README
) -> Iterator[str]:
    """What is missing or cannot be used, and for what."""
    try:
        choose(f"{os.getpid()}")
    except SernError as error:
        yield f"link, sensors, mmcf_lab, sync_lab, fabric: {error}"
    for module, extra in MODULES.items():
        if importlib.util.find_spec(module) is None:
            yield f"link, sensors, robots, relay: {module} is not installed: pip install '.[{extra}]'"
    for name in (recordings.DRIVE, *recordings.SCANS):
        path = data / name
        if path.exists():
            try:
                if name == recordings.DRIVE:
                    read_bag(path, 1.0)
                else:
                    read_ply(path)
            except SernError as error:
                yield f"mmcf_lab: {error}"
    for folder in FOLDERS:
        if not _writable(root / folder):
            yield f"{root / folder}: cannot be written"
    here = [step for step in STEPS if DOCUMENTS[step] == DOCUMENT]
    for path, steps in ((document, here), (readme, [step for step in STEPS if step in IN_README])):
        try:
            text = path.read_text(encoding="utf-8")
            for step in steps:
                insert(text, step, "")
            if not os.access(path, os.W_OK):
                yield f"document: {path} cannot be written"
        except (SernError, OSError) as error:
            yield f"document: {path}: {error}"


def _writable(folder: Path) -> bool:
    """Also of one that is still to be made."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return there.is_dir() and os.access(there, os.W_OK)


def main(problems: Sequence[str] | None = None, arguments: Sequence[str] = ()) -> int:
    about = (__doc__ or "").splitlines()[0]
    argparse.ArgumentParser(prog="python -m benchmarks.ready", description=about).parse_args(arguments)
    found = list(lacking()) if problems is None else problems
    for problem in found:
        print(f"benchmarks.ready: {problem}", file=sys.stderr)
    print(f"mmcf_lab plays {recordings.note()}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(arguments=sys.argv[1:]))
