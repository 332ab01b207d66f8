"""A client's keys while it runs: which it uses, which it offers, which of its relay's it accepts."""

import asyncio
import os
from pathlib import Path

import pytest

from sern_client import keyring as keyring_module
from sern_client.keyring import OFFER_AGAIN_S, ClientKeyring, KeyFiles
from sern_core.vocabulary.key_news import ClientKeys, RelayKeys
from sern_core.vocabulary.types import ClientName
from sern_runtime.config.keys import (
    PublicKey,
    PublicKeys,
    SecretKey,
    fingerprint,
    generate,
    load_public,
    write_public,
    write_secret,
)
from tests.support import until

ROBOT, RELAY = ClientName("robot1"), ClientName("relay")


class Site:
    """A keyring over files, and what it has asked for."""

    def __init__(self, directory: Path, *relay: str) -> None:
        self.files = KeyFiles(directory / "robot1.key", directory / "relay.pub")
        self.first = generate(ROBOT)
        self.now_s = 1e9
        self.used: list[bool] = []
        self.told: list[ClientKeys] = []
        write_secret(self.files.secret, self.first)
        write_public(self.files.server, PublicKeys(RELAY, tuple(map(PublicKey, relay))))
        self.keys = ClientKeyring(self.files, use=self.used.append, tell=self.told.append, at_s=lambda: self.now_s)
        self.keys.read()

    def coming(self) -> SecretKey:
        pair = generate(ROBOT)
        write_secret(self.files.next, pair, replace=True)
        return pair

    def file_keys(self) -> list[str]:
        return [key.key for key in load_public(self.files.server).keys]


@pytest.fixture
def relay() -> tuple[str, ...]:
    return tuple(generate(RELAY).public_key for _ in range(3))


async def test_the_pair_to_come_is_offered_and_used_once_it_is_taken(tmp_path: Path, relay: tuple[str, ...]) -> None:
    site = Site(tmp_path, relay[0])
    site.keys.told(RelayKeys((relay[0],), takes=True))
    assert site.told == [ClientKeys((relay[0],), kept=True)]
    coming = site.coming()
    site.keys.reload()
    assert site.told[1:] == [ClientKeys((relay[0],), kept=True, key=coming.public_key)] and site.used == []
    site.keys.told(RelayKeys((relay[0],), takes=True, key=coming.public_key))
    assert site.keys.keys == coming and site.keys.other == site.first and site.used == [True]
    # Then its file is put in place.
    site.files.next.replace(site.files.secret)
    site.keys.reload()
    assert site.used == [True]
    assert site.keys.to_json()["other"] is None and site.keys.to_json()["in_use"] == fingerprint(coming.public_key)


async def test_what_was_refused_is_offered_again_after_a_while(tmp_path: Path, relay: tuple[str, ...]) -> None:
    site = Site(tmp_path, relay[0])
    coming = site.coming()
    site.keys.read()
    site.keys.told(RelayKeys((relay[0],), takes=False))
    no = RelayKeys((relay[0],), takes=False, key=coming.public_key, code="forbidden", why="not here")
    site.keys.told(no)
    assert (site.keys.problem, site.keys.keys) == ("not here", site.first)
    site.keys.look()
    assert len(site.told) == 1
    site.now_s += OFFER_AGAIN_S
    site.keys.look()
    assert [said.key for said in site.told] == [coming.public_key] * 2
    site.keys.told(RelayKeys((relay[0],), takes=False, key=coming.public_key))
    assert (site.keys.problem, site.keys.keys) == ("", coming)


async def test_a_client_whose_key_is_refused_tries_the_other_and_what_is_in_the_files(
    tmp_path: Path, relay: tuple[str, ...]
) -> None:
    site = Site(tmp_path, relay[0])
    site.keys.refused()
    assert site.keys.keys == site.first and site.used == []
    coming = site.coming()
    site.keys.refused()
    assert site.keys.keys == coming and site.used == [False]
    site.keys.refused()
    assert site.keys.keys == site.first
    site.files.next.replace(site.files.secret)
    site.keys.refused()
    assert site.keys.keys == coming and site.keys.other is None
    site.files.secret.write_text("broken")
    site.keys.refused()
    site.keys.reload()
    assert site.keys.keys == coming, "a file that cannot be read changes nothing"


async def test_the_relays_keys_are_accepted_and_kept(tmp_path: Path, relay: tuple[str, ...]) -> None:
    first, second, third = relay
    site = Site(tmp_path, first)
    site.keys.told(RelayKeys((first, second), takes=False))
    assert site.keys.server_keys == (first, second) and site.used == [False]
    assert site.told[0] == ClientKeys((first, second), kept=False), "said at once, and again when it is written"
    await until(lambda: site.told[-1] == ClientKeys((first, second), kept=True))
    assert site.file_keys() == [first, second]
    site.keys.told(RelayKeys((second,), takes=False))
    await until(lambda: site.told[-1] == ClientKeys((second,), kept=True))
    assert site.file_keys() == [second]
    # One that was put behind it by hand stays, and one that was put in front is over.
    write_public(site.files.server, PublicKeys(RELAY, tuple(map(PublicKey, (first, second, third)))), replace=True)
    site.keys.reload()
    site.keys.told(RelayKeys((second,), takes=False))
    await until(lambda: site.told[-1] == ClientKeys((second, third), kept=True))
    await site.keys.close()


@pytest.mark.parametrize("told", [(), ("short",), ("#" * 40,)], ids=["none", "short", "no key"])
async def test_what_are_no_keys_changes_nothing(tmp_path: Path, relay: tuple[str, ...], told: tuple[str, ...]) -> None:
    site = Site(tmp_path, relay[0])
    site.keys.told(RelayKeys(told, takes=False))
    many = tuple(generate(RELAY).public_key for _ in range(keyring_module.MAX_RELAY_KEYS + 1))
    site.keys.told(RelayKeys(many, takes=False))
    assert site.keys.server_keys == (relay[0],) and site.used == [] and site.file_keys() == [relay[0]]


async def test_where_the_folder_is_read_only_the_relays_keys_hold_until_the_end(
    tmp_path: Path, relay: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    site = Site(tmp_path, relay[0])
    monkeypatch.setattr(os, "access", lambda _path, _mode: False)
    site.keys.told(RelayKeys(relay[:2], takes=False))
    await until(lambda: "the relay's new keys hold until this process ends" in caplog.text)
    await asyncio.wait_for(site.keys.close(), None)
    assert site.keys.server_keys == relay[:2] and site.file_keys() == [relay[0]]
    assert site.told[-1] == ClientKeys(relay[:2], kept=False)
    assert site.keys.to_json()["relay_kept"] is False
