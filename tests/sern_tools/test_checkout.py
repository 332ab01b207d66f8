"""The commit that a report names."""

import shutil
import subprocess
from pathlib import Path

import pytest

from sern_tools.checkout import code, commit


def git(root: Path, *words: str) -> str:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
    done = subprocess.run(["git", "-C", str(root), *identity, *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_code_that_differs_is_told_and_documents_are_not(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    documents = [tmp_path / "docs" / "picture.png", tmp_path / "README.md"]
    code = tmp_path / "code.py"
    for path in (*documents, code):
        path.write_text("a")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "x")
    head = git(tmp_path, "rev-parse", "--short=12", "HEAD")
    assert commit(tmp_path) == head
    for path in documents:
        path.write_text("measured")
    assert commit(tmp_path) == head, "what a benchmark writes does not change what the next one measures"
    code.write_text("b")
    assert commit(tmp_path) == f"{head}-dirty"


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_same_code_is_the_same_whichever_commit_it_is_of(tmp_path: Path) -> None:
    for name in ("core", "docs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text("a")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "x")
    before = code(["core"], tmp_path)
    (tmp_path / "docs" / "a").write_text("b")
    assert code(["core"], tmp_path) == before
    (tmp_path / "core" / "a").write_text("b")
    changed = code(["core"], tmp_path)
    assert changed != before
    git(tmp_path, "commit", "--quiet", "-a", "-m", "y")
    assert code(["core"], tmp_path) == changed, "that it is committed changes nothing"
    (tmp_path / "core" / "a").unlink()
    assert code(["core"], tmp_path) not in (before, changed)


def test_outside_a_checkout_nothing_is_known(tmp_path: Path) -> None:
    assert commit(tmp_path) == code([], tmp_path) == "unknown"
