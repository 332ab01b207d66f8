"""What becomes of keys that another relay has revoked: refused at once, and written down where that is possible."""

import logging
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sern_core.vocabulary.key_news import KeyRevocation
from sern_core.vocabulary.names import peer_name
from sern_core.vocabulary.types import ClientName
from sern_relay.admission import Admission, read_directory
from sern_relay.revocations import REVOKED, FabricRevocations
from sern_runtime.config.key_changes import revoke
from sern_runtime.config.keys import (
    REVOKED_DIR,
    KeyDirectory,
    KeyStatus,
    PublicKey,
    PublicKeys,
    SecretKey,
    fingerprint,
    generate,
    user_id,
    write_public,
)
from sern_runtime.events import EventLog
from sern_runtime.zap import Refusal
from tests.support import until

HUB2, HUB3 = peer_name("hub2"), peer_name("hub3")
ROBOT, OTHER = ClientName("robot1"), ClientName("robot2")


class Relay:
    """A relay's half of it: what it would tell other relays, and how often it was to end what lost its key."""

    def __init__(self, folder: Path | None) -> None:
        self.told: list[KeyRevocation] = []
        self.enforced = 0
        self.events = EventLog()
        self.admission = Admission(read_directory(folder))
        hub: Any = SimpleNamespace(revocations=SimpleNamespace(put=self._put, known=None))
        self.revocations = FabricRevocations(hub, self.admission, self.events, enforce=self._enforce)
        self.revocations.read()

    def _put(self, revocations: Iterable[KeyRevocation], *, now: float) -> None:
        self.told += revocations

    def _enforce(self) -> None:
        self.enforced += 1

    def reload(self, folder: Path) -> None:
        self.admission.replace(read_directory(folder))
        self.revocations.read()

    async def written(self) -> None:
        await until(lambda: not self.revocations.unkept, "it is written down")


def folder_with(path: Path, *keys: SecretKey) -> Path:
    """A folder of client keys; those of one name are in one file."""
    path.mkdir(exist_ok=True)
    for name in {key.name for key in keys}:
        own = tuple(PublicKey(key.public_key) for key in keys if key.name == name)
        write_public(path / f"{name}.pub", PublicKeys(name, own))
    return path


def gone(key: SecretKey, *, last: bool = False) -> KeyRevocation:
    return KeyRevocation(key.name, key.public_key, 1000.0, last)


def status(folder: Path, key: SecretKey) -> KeyStatus:
    """As a relay that starts now would see it."""
    return KeyDirectory(folder).lookup(key.public_key, at_s=2000.0).status


async def test_what_another_relay_has_revoked_is_refused_at_once_and_after_a_restart(tmp_path: Path) -> None:
    first, second, other = generate(ROBOT), generate(ROBOT), generate(OTHER)
    folder = folder_with(tmp_path / "clients", first, second, other)
    relay = Relay(folder)
    relay.revocations.told(HUB2, [gone(first)])
    assert isinstance(relay.admission.lookup(first.public_key, ""), Refusal)
    assert relay.admission.lookup(second.public_key, "") == user_id(ROBOT, second.public_key)
    assert relay.admission.take_lapsed() == {ROBOT: {first.public_key}}
    await until(lambda: relay.enforced == 1)
    await relay.written()
    assert [status(folder, key) for key in (first, second, other)] == [
        KeyStatus.REVOKED, KeyStatus.VALID, KeyStatus.VALID,
    ]  # fmt: skip
    (file,) = (folder / REVOKED_DIR).iterdir()
    assert file.name.startswith("robot1-") and file.name.endswith(".told-by-hub2.pub")
    assert not KeyDirectory(folder).warnings, "it is nowhere else any more"
    assert [event["text"] for event in relay.events.after(0) if event["kind"] == REVOKED] == [
        f"the relay hub2 has revoked the key {fingerprint(first.public_key)} of robot1"
    ]
    relay.reload(folder)
    assert not relay.told, "the others have it from the one that revoked it"
    assert [each.key for each in Relay(folder).told] == [first.public_key], "the next process tells of it"


async def test_who_has_lost_the_last_key_elsewhere_has_none_here(tmp_path: Path) -> None:
    """Where it was known by a key that is revoked: then a further one, which was added here alone, goes as well."""
    first, second, other = generate(ROBOT), generate(ROBOT), generate(OTHER)
    folder = folder_with(tmp_path / "clients", first, second, other)
    relay = Relay(folder)
    relay.revocations.told(HUB2, [gone(first, last=True), gone(generate(OTHER), last=True)])
    assert not relay.admission.known(ROBOT), "its name is out"
    assert relay.admission.known(OTHER), "that is another one of the same name"
    assert [(each.key, each.last) for each in relay.told] == [(second.public_key, True)]
    await relay.written()
    assert [status(folder, key) for key in (first, second)] == [KeyStatus.REVOKED] * 2
    new = generate(ROBOT)
    write_public(folder / "robot1.pub", PublicKeys(ROBOT, (PublicKey(new.public_key),)))
    relay.reload(folder)
    relay.revocations.told(HUB3, [gone(first, last=True)])  # as it is told again in every session
    assert relay.admission.status(ROBOT, new.public_key) is KeyStatus.VALID
    await relay.revocations.close()


async def test_what_is_not_in_the_directory_is_not_written_and_refused_when_it_comes(tmp_path: Path) -> None:
    here, there = generate(ROBOT), generate(OTHER)
    folder = folder_with(tmp_path / "clients", here)
    relay = Relay(folder)
    relay.revocations.told(HUB2, [gone(there)])
    assert not relay.revocations.unkept and not relay.enforced
    write_public(folder / "robot2.pub", PublicKeys(OTHER, (PublicKey(there.public_key),)))  # from an old backup
    relay.reload(folder)
    assert isinstance(relay.admission.lookup(there.public_key, ""), Refusal) and not relay.admission.known(OTHER)
    await relay.written()
    assert status(folder, there) is KeyStatus.REVOKED and not (folder / "robot2.pub").exists()


async def test_where_nothing_can_be_written_it_holds_in_memory_and_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keys = [generate(ROBOT), generate(OTHER)]
    folder = folder_with(tmp_path / "clients", *keys)
    (folder / REVOKED_DIR).write_text("")  # where the folder is to be: whoever runs the test could write any folder
    relay = Relay(folder)
    for key in keys:
        relay.revocations.told(HUB2, [gone(key)])
        await relay.revocations.close()
        assert isinstance(relay.admission.lookup(key.public_key, ""), Refusal)
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert len(errors) == 1 and str(folder / REVOKED_DIR) in errors[0] and relay.revocations.unkept == 2
    relay.reload(folder)
    assert isinstance(relay.admission.lookup(keys[0].public_key, ""), Refusal)
    await relay.revocations.close()
    (folder / REVOKED_DIR).unlink()
    relay.reload(folder)
    await relay.written()
    assert [status(folder, key) for key in keys] == [KeyStatus.REVOKED] * 2


async def test_the_relay_that_revokes_tells_all_keys_and_whether_one_is_left(tmp_path: Path) -> None:
    first, second = generate(ROBOT), generate(OTHER)
    folder = folder_with(tmp_path / "clients", first, second)
    relay = Relay(folder)
    assert not relay.told
    revoke(folder, ROBOT, at_s=1234.5)
    relay.reload(folder)
    assert relay.told == [KeyRevocation(ROBOT, first.public_key, 1234.5, True)]
    write_public(folder / "robot1.pub", PublicKeys(ROBOT, (PublicKey(generate(ROBOT).public_key),)))
    assert [each.last for each in Relay(folder).told] == [False]


async def test_a_relay_without_keys_takes_no_notice() -> None:
    relay = Relay(None)
    relay.revocations.told(HUB2, [gone(generate(ROBOT))])
    assert not relay.told and not relay.revocations.unkept
