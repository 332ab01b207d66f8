"""`sern lab` as a person uses it: what it says, what it refuses, and that it cleans up."""

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner

from sern_core.vocabulary.errors import SernError
from sern_runtime.profiles import load_profile
from sern_tools.lab.cli import app, split_commands
from sern_tools.lab.control import Control, ask
from sern_tools.lab.lab import Lab
from sern_tools.lab.removal import labs
from tests.lab.traffic import datagrams
from tests.support import child

COMMAND = [sys.executable, "-P", "-m", "sern_tools.lab.cli"]


def invoke(*words: str) -> tuple[int, str]:
    """Exit status and all that was written."""
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.output


@contextmanager
def served(lab: Lab) -> Iterator[Control]:
    """The lab answers as one of `sern lab up` does."""
    control = Control(lab, load_profile)
    server = threading.Thread(target=control.serve)
    server.start()
    try:
        yield control
    finally:
        ask(lab.id, {"do": "down"})
        server.join()
        control.close()


@pytest.mark.root
def test_a_running_lab_is_changed_from_outside(lab: Lab) -> None:
    with served(lab):
        status, text = invoke("link", "--lab", lab.id, "--rate", "1mbit", "--delay", "60ms", "--loss", "2%")
        assert status == 0 and text.splitlines() == [
            "up    netem limit 1007 delay 60ms loss 2% rate 1mbit",
            "down  netem limit 1007 delay 60ms loss 2% rate 1mbit",
        ]
        status, text = invoke("link", "--lab", lab.id, "--direction", "down", "--blackout", "--rate", "none")
        assert "down  netem limit 1000 delay 60ms loss 100% rate 100gbit" in text
        assert min(arrival.delay_s for arrival in datagrams(lab.a, lab.b, 20)) > 0.059
        assert datagrams(lab.b, lab.a, 5, passes=False) == []
        assert invoke("link", "--lab", lab.id, "--profile", "satcom")[0] == 0
        assert "delay 250ms loss 2.5% rate 1mbit" in invoke("link", "--lab", lab.id)[1]
        for words, said in (
            (["--profile", "nothing"], "no link profile nothing"),
            (["--loss", "101%"], "loss is 1.01: give a probability"),
            (["--direction", "sideways", "--loss", "1%"], "no direction 'sideways'"),
            (["--rate", "4"], "--rate 4: give a number and one of bit, kbit, mbit, gbit, as 4mbit"),
            (["--profile", "lan", "--loss", "1%"], "either --profile or single changes"),
        ):
            status, text = invoke("link", "--lab", lab.id, *words)
            assert status == 2 and said in text and len(text.splitlines()) == 1
        for changes in (
            {"mood": 1},
            {"loss": None},
            {"loss": True},
            {"jitter": "wild"},
            ["loss"],
            {"loss": float("nan")},
        ):
            with pytest.raises(SernError, match=r"cannot be|is a mapping|loss is nan"):
                ask(lab.id, {"do": "link", "changes": changes})
        with pytest.raises(SernError, match="'dance' is nothing that a lab does"):
            ask(lab.id, {"do": "dance"})


@pytest.mark.root
def test_errors_are_one_line(possible: None) -> None:
    for words, said in (
        (["link", "--lab", "1.1"], "no lab 1.1; running:"),
        (["down", "1.1"], "no lab 1.1; running:"),
        (["up", "--profile", "nothing"], "no link profile nothing"),
        (["up", "--a", "a", "--b", "a"], "two nodes have the same name"),
        (["up", "--backend", "magic"], "no backend 'magic'; there are: native, appliance"),
        (["run", "lan", "true"], "give two commands"),
    ):
        status, text = invoke(*words)
        assert status == 2 and said in text and text.startswith("sern lab: ") and len(text.splitlines()) == 1


def test_without_root_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    for words in (["up"], ["down"], ["link"], ["run", "lan", "--", "true", "--", "true"]):
        status, text = invoke(*words)
        assert status == 2 and "the lab needs root" in text and len(text.splitlines()) == 1


def test_two_commands() -> None:
    assert split_commands(["--", "a", "-x", "--", "b"]) == (["a", "-x"], ["b"])
    assert split_commands(["a", "--", "b", "c"]) == (["a"], ["b", "c"])


@pytest.mark.root
@pytest.mark.lab_long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_up_until_a_signal(possible: None, number: int) -> None:
    with child([*COMMAND, "up", "--profile", "flap"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        words = [process.stdout.readline() for _ in range(10)]
        assert str(process.pid) in words[0]
        process.send_signal(number)
        assert process.stdout.read().endswith("removed\n")
    assert process.returncode == 0
    assert str(process.pid) not in labs()


@pytest.mark.root
@pytest.mark.lab_long
def test_run_two_commands(possible: None) -> None:
    words = ["run", "wifi", "--", "sh", "-c", "exit 7", "--", "sleep", "1000"]
    with child([*COMMAND, *words]) as process:
        assert process.wait() == 7
    assert str(process.pid) not in labs()
