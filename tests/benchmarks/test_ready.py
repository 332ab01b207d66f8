"""What `make performance` needs is looked for before its first step, and everything that is missing is told at once."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("psutil")

from benchmarks import ready, recordings
from benchmarks.document import DOCUMENT, DOCUMENTS, IN_README, README
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
    readme = tmp_path / "README.md"
    readme.write_text(README.read_text().replace("<!-- link end -->", ""))
    told = "\n".join(ready.lacking(document, tmp_path, tmp_path, readme))
    for words in (
        "link, sensors, mmcf_lab, sync_lab, fabric: the lab needs root",
        "no_such_module is not installed: pip install '.[bench]'",
        recordings.DRIVE,
        f"{recordings.SCANS[1]}: is not a PLY file",
        f"{tmp_path / 'build'}: cannot be written",
        "robots begin",
        f"{readme}: has no place for the figures of link",
    ):
        assert words in told
    assert len(told.splitlines()) == 7


def test_who_lacks_something_is_stopped(capsys: pytest.CaptureFixture[str]) -> None:
    assert ready.main(["robots: nothing there"]) == 1
    assert capsys.readouterr().err == "benchmarks.ready: robots: nothing there\n"
    assert ready.main([]) == 0
    with pytest.raises(SystemExit, match="0"):
        ready.main([], ["--help"])
    assert "Whether everything is there" in capsys.readouterr().out


def steps(verb: str) -> list[list[str]]:
    """The benchmarks that a verb runs, in their order: the words after `benchmarks.`."""
    done = subprocess.run(
        ["make", "--dry-run", verb],
        cwd=ready.ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=True,
    )  # fmt: skip
    lines = [shlex.split(line) for line in done.stdout.splitlines() if "-m benchmarks." in line]
    return [words[words.index("-m") + 1 :] for words in lines]


needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed: apt-get install make")


@needs_make
def test_the_steps_of_the_verb_are_those_that_are_looked_at() -> None:
    names = [words[0] for words in steps("performance")]
    assert names == [f"benchmarks.{name}" for name in ("ready", *ready.STEPS, "document")]


@needs_make
def test_every_table_of_a_benchmark_has_a_verb_that_writes_it() -> None:
    """Last comes the document, which gets what each step has written. The matrix is a test's, for `make lab`."""
    written = set()
    for verb in ("performance", "endpoints", "operations", "figures", "cellular", "navigation", "soak"):
        *measured, document = steps(verb)
        files = [words[words.index("--json") + 1] for words in measured if words[0] != "benchmarks.ready"]
        assert document == ["benchmarks.document", *files]
        assert files == [f"build/{words[0].partition('.')[2]}.json" for words in measured if "--json" in words]
        written |= {Path(file).stem for file in files}
    assert written | {"matrix"} == set(DOCUMENTS)
    (document,) = steps("picture")
    assert document == ["benchmarks.document", "build/demo/result.json"]
    assert set(IN_README) == (written & set(IN_README)) | {"demo"}
