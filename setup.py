"""`SERN_COMPILE=1 pip wheel .` compiles the core with mypyc; without it the core stays the Python it is written in."""

import os
from pathlib import Path

from setuptools import Extension, setup

extensions: list[Extension] = []
if os.environ.get("SERN_COMPILE") == "1":
    from mypyc.build import mypycify

    extensions = mypycify([str(path) for path in sorted(Path("sern_core").rglob("*.py"))], opt_level="2", debug_level="0")

setup(ext_modules=extensions)
