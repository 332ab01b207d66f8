"""Which commit this is, for reports."""

import hashlib
import subprocess
from collections.abc import Sequence
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


def code(paths: Sequence[str], root: Path = ROOT) -> str:
    """What tells the tracked files below these paths (git's pathspecs), as they are now, from those of another state;
    `unknown` outside a checkout."""
    try:
        names = _git(root, "ls-files", "-z", "--", *paths).split("\0")
        digest = hashlib.sha256()
        for path in (root / name for name in names if name):
            digest.update(f"{path.relative_to(root)}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest() if path.is_file() else b"")
        return digest.hexdigest()[:12]
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()
