"""Which commit this is, for reports."""

import subprocess
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent


def commit() -> str:
    """The checkout's short commit hash, `-dirty` if tracked files differ; `unknown` outside a checkout."""
    try:
        hash_ = _git("rev-parse", "--short=12", "HEAD")
        return hash_ + ("-dirty" if _git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*words: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()
