"""What an installation has that is no checkout: every file that the daemons and tools look for is in the package."""

import json
import shutil
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Final

import pytest

from sern_runtime.profiles import load_profiles
from tests.support import DEADLINE_S

ROOT: Final = Path(__file__).resolve().parents[2]
PROJECT: Final[dict[str, Any]] = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS: Final = PROJECT["tool"]["setuptools"]
LISTS: Final = """
import json, sern_runtime
from sern_runtime.profiles import load_profile, load_profiles
from sern_tools.lab.cli import app
print(json.dumps([sern_runtime.__file__, list(load_profiles()), load_profile("demo").description]))
"""


def packages() -> list[Path]:
    return [
        path for pattern in SETUPTOOLS["packages"]["find"]["include"] for path in ROOT.glob(pattern) if path.is_dir()
    ]


def test_every_file_of_a_package_is_packaged() -> None:
    data = [pattern for patterns in SETUPTOOLS["package-data"].values() for pattern in patterns]
    files = [path for package in packages() for path in package.rglob("*") if path.is_file()]
    # Whoever imports meanwhile writes compiled files, under other names until they are whole.
    others = [path for path in files if path.suffix != ".py" and "__pycache__" not in path.parts]
    assert [path for path in others if not any(fnmatch(str(path), f"*/{pattern}") for pattern in data)] == []
    assert {path.name for path in others} == {
        "py.typed", "profiles.yaml", "segmentation.onnx", "index.html", "page.css", "page.js",
    }  # fmt: skip


def test_what_is_built_finds_its_profiles_without_the_checkout(tmp_path: Path) -> None:
    """Read them as `sern lab` and `sern demo` of an installation do."""
    pytest.importorskip("setuptools")
    source, built, elsewhere = tmp_path / "source", tmp_path / "built", tmp_path / "elsewhere"
    elsewhere.mkdir()
    for package in packages():
        shutil.copytree(package, source / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = [sys.executable, "-c", "from setuptools import setup; setup()", "-q", "build_py", "--build-lib", str(built)]
    subprocess.run(build, cwd=source, capture_output=True, text=True, timeout=DEADLINE_S, check=True)
    shutil.rmtree(source)
    done = subprocess.run(
        [sys.executable, "-P", "-c", LISTS],
        cwd=elsewhere, env={"PYTHONPATH": str(built)}, capture_output=True, text=True, timeout=DEADLINE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    where, names, demo = json.loads(done.stdout)
    assert Path(where).is_relative_to(built)
    shipped = load_profiles()
    assert (names, demo) == (list(shipped), shipped["demo"].description)
