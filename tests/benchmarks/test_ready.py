"""What `make performance` needs is looked for before its first step, and everything that is missing is told at once."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("psutil")

from benchmarks import ready, recordings
from benchmarks.document import DOCUMENT
from sern_tools.lab.host import LabError
from tests.support import DEADLINE_S


@pytest.fixture(autouse=True)
def lab_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ready, "choose", lambda _lab: None)


def test_without_recordings_nothing_is_missing(tmp_path: Path) -> None:
    assert list(ready.lacking(data=tmp_path)) == []


def test_everything_that_is_missing_is_told_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_lab(_lab: str) -> None:
        raise LabError("the lab needs root")

    monkeypatch.setattr(ready, "choose", no_lab)
    monkeypatch.setattr(ready, "MODULES", {"no_such_module": "bench"})
    (tmp_path / recordings.DRIVE).write_text("no bag")
    (tmp_path / recordings.SCANS[1]).write_text("no scan")
    (tmp_path / "build").write_text("no folder")
    document = tmp_path / "performance.md"
    document.write_text(DOCUMENT.read_text().replace("<!-- robots begin -->", ""))
    told = "\n".join(ready.lacking(document, tmp_path, tmp_path))
    for words in (
        "link, mmcf_lab: the lab needs root",
        "no_such_module is not installed: pip install '.[bench]'",
        recordings.DRIVE,
        f"{recordings.SCANS[1]}: is not a PLY file",
        f"{tmp_path / 'build'}: cannot be written",
        "robots begin",
    ):
        assert words in told
    assert len(told.splitlines()) == 6


def test_who_lacks_something_is_stopped(capsys: pytest.CaptureFixture[str]) -> None:
    assert ready.main(["robots: nothing there"]) == 1
    assert capsys.readouterr().err == "benchmarks.ready: robots: nothing there\n"
    assert ready.main([]) == 0


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_the_steps_of_the_verb_are_those_that_are_looked_at() -> None:
    """First the look, last the document, which gets what each step has written."""
    done = subprocess.run(
        ["make", "--dry-run", "performance"],
        cwd=ready.ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=True,
    )  # fmt: skip
    steps = [words for line in done.stdout.splitlines() if "-m benchmarks." in line for words in [shlex.split(line)]]
    names = [next(word for word in words if word.startswith("benchmarks.")).partition(".")[2] for words in steps]
    assert names == ["ready", *ready.STEPS, "document"]
    written = [words[words.index("--json") + 1] for words in steps[1:-1]]
    assert steps[-1][-len(written) :] == written
