"""`SERN_COMPILE=1` builds a wheel whose core mypyc has compiled (`make wheel`). Without it the core stays Python."""

import os
from pathlib import Path

from setuptools import Extension, setup

extensions: list[Extension] = []
if os.environ.get("SERN_COMPILE") == "1":
    from mypyc.build import mypycify

    sources = [str(path) for path in sorted(Path("sern_core").rglob("*.py"))]
    extensions = mypycify(sources, opt_level="2", debug_level="0")

setup(ext_modules=extensions)
