"""Free ports: two that look for one at the same time get different ones."""

import os
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Iterator

import pytest

from sern_core.errors import SernError
from sern_tools import ports

NAME = f"tests-{os.getpid()}"


@pytest.fixture(autouse=True)
def own_claims(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(ports, "_claims", deque())
    yield
    ports.release_claims()


def test_a_claim_holds_in_this_process_and_in_others_until_it_is_released() -> None:
    assert ports.claim(f"{NAME}-one")
    assert not ports.claim(f"{NAME}-one")
    program = f"from sern_tools.ports import claim; print(claim('{NAME}-one'), claim('{NAME}-two'))"
    command = [sys.executable, "-P", "-c", program]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "False True\n"
    ports.release_claims()
    assert ports.claim(f"{NAME}-one") and ports.claim(f"{NAME}-two"), "claims end with their process"


def test_the_oldest_claims_end_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "CLAIMS", 2)
    assert all(ports.claim(f"{NAME}-{number}") for number in range(3))
    assert ports.claim(f"{NAME}-0") and not ports.claim(f"{NAME}-2")


def test_ports_that_are_in_use_or_claimed_are_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    (first,) = ports.free_ports(1)
    monkeypatch.setattr(ports, "PORTS", range(first, first + 1))
    with pytest.raises(SernError, match="no 1 free ports"):
        ports.free_ports(1)
    ports.release_claims()
    assert ports.free_ports(1) == [first]
    ports.release_claims()
    with socket.socket() as listener:
        listener.bind((ports.HOST, first))
        with pytest.raises(SernError, match="no 1 free ports"):
            ports.free_ports(1)
