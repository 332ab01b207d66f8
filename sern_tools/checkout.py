"""Which commit this is, for reports."""

import subprocess
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
CODE: Final = (".", ":(exclude)docs", ":(exclude)*.md")
"""Documents and their pictures are written while figures are measured, and change none."""


def commit(root: Path = ROOT) -> str:
    """The checkout's short commit hash, `-dirty` if tracked files other than documents differ; `unknown` outside a
    checkout."""
    try:
        hash_ = _git(root, "rev-parse", "--short=12", "HEAD")
        return hash_ + ("-dirty" if _git(root, "status", "--porcelain", "--untracked-files=no", "--", *CODE) else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()
