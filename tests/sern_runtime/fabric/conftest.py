"""Certificates are made once: three relays of one authority, and the same names of another one."""

from pathlib import Path

import pytest

from sern_tools.keygen_fabric import make_fabric
from tests.sern_runtime.fabric.relays import A, B, C


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fabric")
    make_fabric([A, B, C], out=folder)
    return folder


@pytest.fixture(scope="session")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("foreign")
    make_fabric([A, B, C], out=folder)
    return folder
