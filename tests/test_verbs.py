"""The verbs of the Makefile: what `make explore` draws can be drawn again, and `make lab` leaves nothing out."""

import ast
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from textwrap import dedent
from typing import Final

import pytest

from tests.matrix.cells import CELLS
from tests.support import DEADLINE_S

ROOT: Final = Path(__file__).resolve().parents[1]
SEED: Final = "7"
RANDOM: Final = ("hypothesis", "tests.exploring")
DRAWS: Final = """
    from hypothesis import given, strategies
    from tests.exploring import load_profile
    load_profile()

    @given(strategies.integers(0, 2**64))
    def test_draws(number):
        with open("drawn", "a") as file:
            print(number, file=file)
"""

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")


def commands(*arguments: str) -> list[list[str]]:
    """The words of every command that a verb would run."""
    done = subprocess.run(
        ["make", "--dry-run", "--always-make", *arguments],
        cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=True,
    )  # fmt: skip
    return [shlex.split(line) for line in done.stdout.splitlines()]


def pytest_commands(*arguments: str) -> list[list[str]]:
    """What a verb gives to pytest, with the variables in front of it."""
    found = [words for words in commands(*arguments) if words[-1:] != ["pytest"] and "pytest" in words]
    return [
        [word for word in words[: words.index("-m")] if "=" in word] + words[words.index("pytest") + 1 :]
        for words in found
    ]


@pytest.mark.parametrize(("version", "status"), [((3, 8), 2), ((3, 10), 2), ((3, 11), 0), ((3, 13), 0)])
def test_a_python_that_is_too_old_makes_nothing(tmp_path: Path, version: tuple[int, int], status: int) -> None:
    """It stands in for one that has another version, and notes what else it is asked to do."""
    python = tmp_path / "python"
    body = f"""#!{sys.executable}
import sys
if sys.argv[1] == "-c":
    sys.version_info = {(*version, 0, "final", 0)}
    exec(sys.argv[2])
else:
    open({str(tmp_path / "asked")!r}, "a").write(" ".join(sys.argv[1:]))
    pip = {str(tmp_path / "venv/bin/python")!r}
    import os
    os.makedirs(os.path.dirname(pip))
    os.symlink("/bin/true", pip)
"""
    python.write_text(body)
    python.chmod(0o755)
    done = subprocess.run(
        ["make", "setup", f"PYTHON={python}", f"VENV={tmp_path / 'venv'}"],
        cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=False,
    )  # fmt: skip
    assert done.returncode == status, done.stdout + done.stderr
    said = [line for line in done.stderr.splitlines() if "SERN needs" in line]
    if status:
        (line,) = said
        assert f"is Python {version[0]}.{version[1]}, SERN needs 3.11 to 3.13" in line and "deploy/README.md" in line
        assert "make PYTHON=python3.11 setup" in line  # without its verb it would print the help
        assert not (tmp_path / "asked").exists() and not (tmp_path / "venv").exists()
    else:
        assert said == [] and (tmp_path / "asked").read_text() == f"-m venv {tmp_path / 'venv'}"


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def test_explore_takes_every_file_with_random_input_and_hands_its_seed_on() -> None:
    (words,) = pytest_commands("explore", f"SEED={SEED}")
    assert {f"SERN_EXPLORE={SEED}", f"--hypothesis-seed={SEED}"} <= set(words)
    assert ["echo", f"SEED={SEED}"] in commands("explore", f"SEED={SEED}")
    files = [path for path in (ROOT / "tests").rglob("test_*.py") if "peers" not in path.parts]
    drawing = {str(path.relative_to(ROOT)) for path in files if any(name.startswith(RANDOM) for name in imports(path))}
    assert {word for word in words if word.startswith("tests/")} == drawing
    assert len(drawing) > 40


def test_without_a_seed_all_of_explore_has_the_same_one() -> None:
    (words,) = pytest_commands("explore")
    given = [word.partition("=") for word in words if word.startswith(("SERN_EXPLORE=", "--hypothesis-seed="))]
    assert [name for name, _, _ in given] == ["SERN_EXPLORE", "--hypothesis-seed"]
    assert len({seed for _, _, seed in given}) == 1 and given[0][2].isdigit()


def drawn(directory: Path, seed: str) -> list[str]:
    (words,) = pytest_commands("explore", f"SEED={seed}")
    options = [word for word in words if word.startswith("--hypothesis-seed")]
    (directory / "test_draws.py").write_text(dedent(DRAWS))
    (directory / "drawn").unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options, "test_draws.py"]
    environment = {"PATH": "", "PYTHONPATH": str(ROOT), "SERN_EXPLORE": seed}
    subprocess.run(command, cwd=directory, env=environment, capture_output=True, timeout=DEADLINE_S, check=True)
    return (directory / "drawn").read_text().split()


def test_a_seed_draws_the_same_cases_again_and_another_one_others(tmp_path: Path) -> None:
    first = drawn(tmp_path, SEED)
    assert len(first) > 500, "ten times what a usual run draws where a test asks for no number"
    assert drawn(tmp_path, SEED) == first
    assert drawn(tmp_path, "8") != first


def test_lab_runs_every_cell_of_the_matrix() -> None:
    (words,) = [words for words in pytest_commands("lab") if "tests/matrix" in words]
    command = [sys.executable, "-m", "pytest", "--collect-only", "-p", "no:cacheprovider", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    lines = [line for line in done.stdout.splitlines() if "::test_promises_hold" in line]
    collected = {line.partition("[")[2].rstrip("]") for line in lines}
    assert collected == {str(cell) for cell in CELLS}, done.stdout + done.stderr
