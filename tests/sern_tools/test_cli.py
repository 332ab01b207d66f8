"""The `sern` command before it does anything."""

import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import sern_core.link.link

INTERRUPTED_AT = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "MODULE":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
sys.argv = ["sern", "--help"]
from sern_tools.cli import main
main()
"""


def test_ctrl_c_during_the_imports_is_an_end_without_a_traceback() -> None:
    for module in ("sern_tools.commands", "sern_runtime.config.keys"):
        program = INTERRUPTED_AT.replace("MODULE", module)
        done = subprocess.run(
            [sys.executable, "-P", "-c", program], capture_output=True, text=True, timeout=120, check=False
        )
        assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


PROGRAMS = ("sern", "sern-relay", "sern-client", "sern-twin", "sern-navigation")


@pytest.mark.parametrize("program", PROGRAMS)
def test_each_program_says_its_version_and_whether_its_core_is_compiled(program: str) -> None:
    done = subprocess.run(
        [Path(sys.executable).with_name(program), "--version"], capture_output=True, text=True, timeout=120, check=False
    )
    source = Path(sern_core.link.link.__file__).suffix == ".py"
    core = "plain Python" if source else "compiled"
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{program} {version('sern')}, {core} core\n", "")


@pytest.mark.parametrize("program", PROGRAMS[1:])
def test_each_daemon_takes_the_format_of_its_log(program: str, tmp_path: Path) -> None:
    missing = tmp_path / "missing.yaml"
    for log_format, words in (("json", "no such file"), ("xml", "'text', 'json'")):
        done = subprocess.run(
            [Path(sys.executable).with_name(program), "--config", missing, "--log-format", log_format],
            capture_output=True, text=True, timeout=120, check=False, env={**os.environ, "COLUMNS": "200"},
        )  # fmt: skip
        assert done.returncode == 2
        assert words in done.stderr


def test_the_shell_completes_the_subcommands() -> None:
    environment = {**os.environ, "_SERN_COMPLETE": "complete_bash", "COMP_WORDS": "sern t", "COMP_CWORD": "1"}
    done = subprocess.run(
        [Path(sys.executable).with_name("sern")], capture_output=True, text=True, timeout=120, check=False,
        env=environment,
    )  # fmt: skip
    assert set(done.stdout.split()) == {"top", "topics", "take"}
