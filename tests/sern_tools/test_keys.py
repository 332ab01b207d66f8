"""`sern keys list` and `revoke`: what the files say, what the running relay says, and one line for what goes wrong."""

import asyncio
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from sern_core.vocabulary.errors import SernError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.key_changes import revoke
from sern_runtime.config.keys import (
    KeyDirectory,
    KeyStatus,
    PublicKey,
    PublicKeys,
    fingerprint,
    generate,
    load_public,
    write_public,
)
from sern_runtime.config.relay import load_relay
from sern_tools import keys
from sern_tools.commands import app
from tests.daemons import Lab

DEAD_ENDS = {"kind": "synthetic", "role": "robot", "topics": 1}


def sern(*words: str) -> Result:
    return CliRunner().invoke(app, words)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path, "robot1", "robot2")


def mark_of(lab: Lab, name: str) -> str:
    return fingerprint(load_public(lab.clients_dir / f"{name}.pub").keys[0].key)


def test_without_a_daemon_all_keys_are_listed_and_who_is_connected_is_not_known(lab: Lab) -> None:
    config = lab.relay_file()
    late = generate(ClientName("robot3"))
    times = PublicKey(late.public_key, not_before_s=4e9, not_after_s=5e9)
    write_public(lab.clients_dir / "robot3.pub", PublicKeys(late.name, (times,)))
    revoke(lab.clients_dir, ClientName("robot2"), at_s=2e9)
    done = sern("keys", "list", "--config", str(config))
    assert done.exit_code == 0
    rows = {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines()}
    assert rows["relay"][1] == fingerprint(load_public(lab.directory / "relay.pub").keys[0].key)
    assert rows["robot1"] == [mark_of(lab, "robot1"), "valid", "?"]
    assert rows["robot3"][1:] == ["not", "yet", "2096-10-02T07:06:40Z", "2128-06-11T08:53:20Z", "?"]
    assert rows["robot2"][1:] == ["revoked", "2033-05-18T03:33:20Z", "?"]
    assert done.stderr.startswith("who is connected is not known: http://127.0.0.1:")
    listed = json.loads(sern("keys", "list", "--json", "--config", str(config)).stdout)
    assert [(row["name"], row["status"]) for row in listed["clients"]] == [
        ("robot1", "valid"), ("robot3", "not_yet"), ("robot2", "revoked")
    ]  # fmt: skip


async def test_a_running_relay_says_who_is_connected_and_lets_a_revoked_key_go_at_once(tmp_path: Path) -> None:
    async with Lab(tmp_path, "robot1", "robot2") as lab:
        relay = await lab.process(lab.relay_file()).ready()
        robot = await lab.process(lab.client_file("robot1", DEAD_ENDS)).ready()
        loaded, mark, said = load_relay(relay.config), mark_of(lab, "robot1"), list[str]()
        found = await asyncio.to_thread(keys.listed, loaded, at_s=1e9)
        assert [row["connected"] for row in found["clients"]] == [True, False] and found["problem"] == ""
        await asyncio.to_thread(keys.run_revoke, loaded, "robot1", at_s=1.7e9, out=said.append)
        assert said[0].startswith(f"revoked {mark} of robot1; kept in ")
        assert said[1].startswith("the relay says that no key of robot1 holds, after ")
        await robot.until(lambda: robot.get("/readyz")[0] == 503, "is out")
        # Put back by mistake, the key still lets nobody in.
        kept = next((lab.clients_dir / "revoked").glob("robot1-*.pub"))
        key = load_public(kept).keys[0].key
        write_public(lab.clients_dir / "robot1.pub", PublicKeys(ClientName("robot1"), (PublicKey(key),)))
        await asyncio.to_thread(keys.run_revoke, loaded, "robot1", at_s=1.7e9, out=said.append)
        assert said[2] == "robot1 was revoked at 2023-11-14T22:13:20Z"
        assert not (lab.clients_dir / "robot1.pub").exists()
        await relay.said(f"the key {mark} of robot1 is revoked")
        await robot.stop()
        await relay.stop()


def test_revoking_without_a_daemon_takes_the_key_out_and_says_what_is_left_to_do(lab: Lab) -> None:
    config = str(lab.relay_file())
    done = sern("keys", "revoke", "robot1", "--config", config)
    assert done.exit_code == 1
    assert "the files are changed, and no daemon was told" in done.stderr and done.stderr.count("\n") == 1
    assert done.stderr.endswith("reload it with: sudo systemctl reload sern-relay\n")
    assert KeyDirectory(lab.clients_dir).names == ("robot2",)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("revoke", "robot12"), r"no client robot12 has a key in {dir}/clients; did you mean robot1 or robot2?"),
        (("revoke", "zebra"), r"no client zebra has a key in {dir}/clients; there are: robot1, robot2"),
        (("revoke", "Zebra"), r"client name 'Zebra' must be"),
        (("add", "zebra", "x"), r"zebra has no key in {dir}/clients that holds; use sern enroll open zebra"),
        (("add", "robot1", "x"), r"what was offered is no CURVE key"),
        (("rotate", "--switch"), r"there is no {dir}/relay.next.key; make it with sern keys rotate"),
    ],
)
def test_errors_are_one_line(lab: Lab, words: tuple[str, ...], said: str) -> None:
    done = sern("keys", *words, "--config", str(lab.relay_file()))
    assert done.exit_code == 2
    assert said.format(dir=lab.directory) in done.stderr and done.stderr.count("\n") == 1


def test_what_belongs_to_another_user_is_left_alone(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    config, stranger = str(lab.relay_file()), os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: stranger)
    for words in (("revoke", "robot1"), ("rotate",)):
        done = sern("keys", *words, "--config", config)
        assert done.exit_code == 2 and "give the command as that user, with sudo -u" in done.stderr
    assert KeyDirectory(lab.clients_dir).names == ("robot1", "robot2")


class EndedHereError(Exception):
    """The command's process ended."""


def ends(*_args: object, **_kwargs: object) -> None:
    raise EndedHereError


@pytest.mark.parametrize("step", ["unlink", "hardlink_to"])
def test_a_revocation_that_ends_in_the_middle_is_done_again(
    lab: Lab, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the revoked key is written it holds, from then on it does not."""
    key = load_public(lab.clients_dir / "robot1.pub").keys[0].key
    genuine: Callable[..., None] = getattr(Path, step)

    def stopped(path: Path, *args: object, **kwargs: object) -> None:
        if step == "hardlink_to" or path == lab.clients_dir / "robot1.pub":
            raise EndedHereError
        genuine(path, *args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(Path, step, stopped)
        with pytest.raises(EndedHereError):
            revoke(lab.clients_dir, ClientName("robot1"), at_s=2e9)
    expected = KeyStatus.REVOKED if step == "unlink" else KeyStatus.VALID
    assert KeyDirectory(lab.clients_dir).lookup(key, at_s=2e9).status is expected
    revoke(lab.clients_dir, ClientName("robot1"), at_s=2e9)
    directory = KeyDirectory(lab.clients_dir)
    assert directory.names == ("robot2",) and directory.lookup(key, at_s=2e9).status is KeyStatus.REVOKED


def test_a_process_that_is_no_daemon_of_ours_is_not_told(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "get_json", lambda _api, _path: {"pid": 1})
    killed: list[int] = []
    monkeypatch.setattr(os, "kill", lambda pid, _number: killed.append(pid))
    with pytest.raises(SernError, match="is not on this machine; reload it with: sudo systemctl reload sern-relay"):
        keys.Running("http://127.0.0.1:1", "sern-relay").reload()
    assert killed == []
