"""Changes of the folder of client keys: who may bring which key, and that what is revoked stays out."""

import fcntl
import os
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError, RefusedError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.key_changes import MAX_VALID, add_client, revoke, take_in
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

ROBOT, OTHER = ClientName("robot1"), ClientName("robot2")
NOW_S = 1e9
DAY_S = 86_400.0


def a_key() -> str:
    return generate(ROBOT).public_key


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (ROBOT, OTHER):
        write_public(tmp_path / f"{name}.pub", PublicKeys(name, (PublicKey(a_key()),)))
    return tmp_path


def key_of(folder: Path, name: ClientName = ROBOT) -> str:
    return load_public(folder / f"{name}.pub").keys[0].key


def take(folder: Path, new: str, *, name: ClientName = ROBOT, asking: str = "", at_s: float = NOW_S) -> PublicKey:
    return take_in(folder, name, asking or key_of(folder), new, at_s=at_s, overlap_s=DAY_S)


def test_a_key_comes_beside_the_one_that_asks_which_ends_later(folder: Path) -> None:
    old, new = key_of(folder), a_key()
    assert take(folder, new) == PublicKey(new)
    expected = (PublicKey(old, not_after_s=NOW_S + DAY_S), PublicKey(new))
    assert load_public(folder / "robot1.pub").keys == expected
    assert take(folder, new, at_s=NOW_S + 1) == PublicKey(new), "asked again, nothing changes"
    assert load_public(folder / "robot1.pub").keys == expected
    third = a_key()
    take(folder, third, asking=new, at_s=NOW_S + DAY_S + 1)
    assert [key.key for key in load_public(folder / "robot1.pub").keys] == [new, third], "what has ended goes"


def test_no_key_holds_longer_than_the_one_that_asked_for_it(folder: Path) -> None:
    old = PublicKey(key_of(folder), not_after_s=NOW_S + 60)
    write_public(folder / "robot1.pub", PublicKeys(ROBOT, (old,)), replace=True)
    assert take(folder, new := a_key()) == PublicKey(new, not_after_s=NOW_S + 60)
    assert load_public(folder / "robot1.pub").keys[0] == old


@pytest.mark.parametrize("case", ["other name", "other's key", "no key", "revoked", "expired", "unknown", "too many"])
def test_what_is_refused_changes_no_file(folder: Path, case: str) -> None:
    new, name, asking, at_s = a_key(), ROBOT, key_of(folder), NOW_S
    code = "old_key"
    if case == "other name":
        name = OTHER
    elif case == "other's key":
        new, code = key_of(folder, OTHER), "bad_key"
    elif case == "no key":
        new, code = "short", "bad_key"
    elif case == "revoked":
        new, code = key_of(folder, OTHER), "bad_key"
        revoke(folder, OTHER, at_s=NOW_S)
    elif case == "expired":
        write_public(folder / "robot1.pub", PublicKeys(ROBOT, (PublicKey(asking, not_after_s=1.0),)), replace=True)
    elif case == "unknown":
        asking = a_key()
    else:
        code = "too_many_keys"
        for _ in range(MAX_VALID - 1):
            take(folder, a_key())
    before = (folder / "robot1.pub").read_text()
    with pytest.raises(RefusedError) as refusal:
        take(folder, new, name=name, asking=asking, at_s=at_s)
    assert refusal.value.code == code
    assert (folder / "robot1.pub").read_text() == before


def test_a_file_that_cannot_be_written_stays_as_it_was(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, new = (folder / "robot1.pub").read_text(), a_key()

    def full(_path: Path, _target: Path) -> Path:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(ConfigError, match="can not be written: No space left on device"):
            take(folder, new)
    assert (folder / "robot1.pub").read_text() == before
    assert KeyDirectory(folder).warnings == (), "what was begun is not looked at"
    assert take(folder, new) == PublicKey(new)


def test_what_is_revoked_lets_nobody_in_wherever_it_stands(folder: Path) -> None:
    key, new = key_of(folder), a_key()
    take(folder, new)
    done = revoke(folder, ROBOT, at_s=NOW_S)
    assert {each.key for each in done.keys} == {key, new} and done.file is not None
    assert revoke(folder, ROBOT, at_s=NOW_S + 5) == ((), None)
    write_public(folder / "robot1.pub", PublicKeys(ROBOT, (PublicKey(key),)))
    directory = KeyDirectory(folder)
    assert directory.names == (OTHER,)
    assert directory.lookup(key, at_s=NOW_S).status is directory.lookup(new, at_s=NOW_S).status is KeyStatus.REVOKED
    said = f"{folder}/robot1.pub: the key {fingerprint(key)} of robot1 is revoked, and lets nobody in"
    assert directory.warnings == (said,)
    with pytest.raises(ConfigError, match="holds that key already, or held it once"):
        add_client(folder, PublicKeys(ROBOT, (PublicKey(key),)), replacing=True, at_s=NOW_S)


def test_a_change_waits_for_another_that_is_under_way(folder: Path) -> None:
    """Else a key that is taken in meanwhile would outlive the revocation of its name."""
    descriptor = os.open(folder, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    key, done = key_of(folder), threading.Event()

    def revoked() -> None:
        revoke(folder, ROBOT, at_s=NOW_S)
        done.set()

    thread = threading.Thread(target=revoked)
    thread.start()
    assert KeyDirectory(folder).lookup(key, at_s=NOW_S).status is KeyStatus.VALID and not done.is_set()
    os.close(descriptor)
    thread.join()
    assert KeyDirectory(folder).lookup(key, at_s=NOW_S).status is KeyStatus.REVOKED


def test_keys_of_several_files_are_revoked_together(folder: Path) -> None:
    more = tuple(PublicKey(a_key()) for _ in range(16))
    write_public(folder / "robot1-2030.pub", PublicKeys(ROBOT, more))
    revoke(folder, ROBOT, at_s=NOW_S)
    directory = KeyDirectory(folder)
    assert directory.names == (OTHER,) and len(directory.revoked()) == 17
    assert {key for _, key in directory.revoked()} >= {replace(key, not_after_s=NOW_S) for key in more}
