"""The `sern` command before it does anything."""

import signal
import subprocess
import sys

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
