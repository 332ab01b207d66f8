"""The packages under test, and the root file system they are installed in. `make test-install` builds them first."""

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest

from tests.install.machine import base, layered, missing

VARIABLE: Final = "SERN_PACKAGES"


def package(name: str) -> Path:
    """The file of a Debian package of this checkout; skips where this is no `make test-install`."""
    folder = os.environ.get(VARIABLE)
    if not folder:
        pytest.skip("make test-install builds the Debian packages and runs this")
    (found,) = Path(folder).resolve().glob(f"{name}_*.deb")
    return found


@pytest.fixture(scope="session")
def sern_package() -> Path:
    return package("sern")


@pytest.fixture(scope="session")
def twin_package() -> Path:
    return package("sern-twin")


@pytest.fixture(scope="module")
def root(sern_package: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A clean Debian of its own for each file of tests."""
    if os.geteuid() != 0:
        pytest.skip("needs root: sudo make test-install")
    if lacking := missing("debootstrap", "systemd-nspawn", "nsenter"):
        pytest.skip(lacking)
    lower = base()
    with ExitStack() as stack:
        try:
            merged = stack.enter_context(layered(lower, tmp_path_factory.mktemp("root") / "layer"))
        except OSError as error:
            pytest.skip(f"no overlay of file systems here: {error}")
        yield merged
