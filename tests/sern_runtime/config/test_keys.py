"""Key files and the directory of client keys: round trips, windows, and what is said about bad files."""

import stat
from pathlib import Path

import pytest
import zmq
from zmq.utils import z85

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.types import ClientName
from sern_runtime.config import keys
from sern_runtime.config.keys import KeyDirectory, KeyMatch, KeyStatus, PublicKey, PublicKeys

NAME = ClientName("jackal1")
GOOD = "W/<tzpy]p5MX1kPs3?Jw<H7{823Ycpi0%*{ujHp."


def public(tmp_path: Path, *entries: PublicKey, name: str = "jackal1", file: str = "jackal1.pub") -> Path:
    path = tmp_path / file
    keys.write_public(path, PublicKeys(ClientName(name), entries))
    return path


def new_key(not_before_s: float | None = None, not_after_s: float | None = None) -> PublicKey:
    return PublicKey(keys.generate(NAME).public_key, not_before_s, not_after_s)


def test_round_trip(tmp_path: Path) -> None:
    pair = keys.generate(NAME)
    keys.write_secret(tmp_path / "a.key", pair)
    assert keys.load_secret(tmp_path / "a.key") == pair
    assert pair.secret_key not in repr(pair)
    assert stat.S_IMODE((tmp_path / "a.key").stat().st_mode) == 0o600
    assert keys.secret_warning(tmp_path / "a.key") is None
    entries = (new_key(), new_key(0.0, 1e9), new_key(not_after_s=1767225600.5))
    assert keys.load_public(public(tmp_path, *entries)) == PublicKeys(NAME, entries)


def test_every_generated_pair_survives_the_file(tmp_path: Path) -> None:
    for index in range(50):  # Z85 text is full of characters that mean something to YAML
        pair = keys.generate(NAME)
        path = tmp_path / f"{index}.key"
        keys.write_secret(path, pair)
        assert keys.load_secret(path) == pair


def test_files_are_never_overwritten_unasked(tmp_path: Path) -> None:
    pair, other = keys.generate(NAME), keys.generate(NAME)
    path = tmp_path / "a.key"
    keys.write_secret(path, pair)
    with pytest.raises(ConfigError, match=r"a\.key: exists already; --force replaces it$"):
        keys.write_secret(path, other)
    assert keys.load_secret(path) == pair
    path.chmod(0o644)
    keys.write_secret(path, other, replace=True)
    assert keys.load_secret(path) == other
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.key"]
    link = tmp_path / "link.key"
    link.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="exists already"):
        keys.write_secret(link, pair)
    with pytest.raises(ConfigError, match=r"can not be written: No such file or directory$"):
        keys.write_secret(tmp_path / "none" / "a.key", pair)


PUBLIC_HEAD = "sern_key: public\nname: jackal1\n"
BAD_PUBLIC = {
    "": ":1: the file must be a mapping (key: value)",
    "a: 1\n": ":1: is not a SERN key file; make one with sern keygen (a public key is needed here)",
    "sern_key: publik\n": ":1: sern_key: 'publik' is not accepted (did you mean public?); accepted: public",
    "sern_key: secret\n": ":1: is a secret key file; the public one is needed here (NAME.pub)",
    PUBLIC_HEAD: ":1: keys: is missing",
    PUBLIC_HEAD + "keys: []\n": ":3: keys: is too short; at least 1 needed",
    PUBLIC_HEAD + "keys:\n  - public_key: abc\n": (
        ":4: keys.0.public_key: is not a CURVE key: 40 characters of Z85 text, in quotes"
    ),
    PUBLIC_HEAD + f"keys:\n  - public_key: '{'#' * 40}'\n": (
        ":4: keys.0.public_key: is not a CURVE key: 40 characters of Z85 text, in quotes"
    ),
    PUBLIC_HEAD + f"keys:\n  - public_key: '{GOOD}'\n    not_before: soon\n": (
        ":5: keys.0.not_before: 'soon' is not a time with its zone, such as 2026-01-31T12:00:00Z"
    ),
    PUBLIC_HEAD + f"keys:\n  - public_key: '{GOOD}'\n    not_after: 2026-01-31T12:00:00\n": (
        ":5: keys.0.not_after: '2026-01-31T12:00:00' is not a time with its zone, such as 2026-01-31T12:00:00Z"
    ),
    PUBLIC_HEAD
    + f"keys:\n  - public_key: '{GOOD}'\n    not_before: 2026-02-01T00:00:00Z\n    not_after: 2026-01-01T00:00:00Z\n": (
        ":6: keys.0.not_after: is not after not_before: the key would never be accepted"
    ),
    PUBLIC_HEAD + f"keys:\n  - public_key: '{GOOD}'\n    not_befor: x\n": (
        ":5: keys.0.not_befor: unknown key (did you mean not_before?); accepted: public_key, not_before, not_after"
    ),
    "sern_key: public\nname: Jackal\nkeys: []\n": (
        ":2: name: client name 'Jackal' must be a lower-case letter, then up to 62 of a-z, 0-9, '_'"
    ),
}


@pytest.mark.parametrize("text", BAD_PUBLIC)
def test_bad_public_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "jackal1.pub"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        keys.load_public(path)
    assert str(caught.value) == f"{path}{BAD_PUBLIC[text]}"
    with pytest.raises(ConfigError) as caught:
        KeyDirectory(tmp_path)
    assert str(caught.value) == f"{path}{BAD_PUBLIC[text]}"


def test_bad_secret_file_never_shows_the_secret(tmp_path: Path) -> None:
    pair, other = keys.generate(NAME), keys.generate(NAME)
    path = tmp_path / "a.key"
    public_text = keys.public_text(PublicKeys(NAME, (PublicKey(other.public_key),)))
    good = keys.secret_text(pair)
    cases = {
        good.replace(pair.public_key, other.public_key): (
            ":4: public_key: does not belong to secret_key; make a new pair with sern keygen"
        ),
        good.replace(f'"{pair.secret_key}"', "12345678"): ":5: secret_key: expected text, not what is there",
        good.replace(pair.secret_key, pair.secret_key[:39]): (
            ":5: secret_key: is not a CURVE key: 40 characters of Z85 text, in quotes"
        ),
        public_text: ":2: is a public key file; the secret one is needed here (NAME.key)",
    }
    for text, said in cases.items():
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError) as caught:
            keys.load_secret(path)
        assert str(caught.value) == f"{path}{said}"
        assert "12345678" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"none\.key: no such file$"):
        keys.load_secret(tmp_path / "none.key")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o601])
def test_open_secret_is_a_warning(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "a.key"
    keys.write_secret(path, keys.generate(NAME))
    path.chmod(mode)
    assert keys.secret_warning(path) == (
        f"{path} is open to others than its owner (mode {mode:04o}); run: chmod 600 {path}"
    )


def test_directory_looks_up_by_key_and_time(tmp_path: Path) -> None:
    old, new, other = new_key(not_after_s=200.0), new_key(not_before_s=100.0), new_key()
    public(tmp_path, old)
    public(tmp_path, new, file="jackal1-next.pub")
    public(tmp_path, other, name="site1", file="site1.pub")
    directory = KeyDirectory(tmp_path)
    assert directory.names == ("jackal1", "site1")
    assert directory.keys_of(NAME) == (new, old)
    assert directory.warnings == ()
    for at_s, old_status, new_status in (
        (99.0, KeyStatus.VALID, KeyStatus.NOT_YET),
        (100.0, KeyStatus.VALID, KeyStatus.VALID),
        (200.0, KeyStatus.VALID, KeyStatus.VALID),
        (201.0, KeyStatus.EXPIRED, KeyStatus.VALID),
    ):
        assert directory.lookup(old.key, at_s=at_s) == KeyMatch(old_status, NAME, old)
        assert directory.lookup(new.key, at_s=at_s) == KeyMatch(new_status, NAME, new)
    assert directory.lookup(z85.decode(other.key), at_s=0) == KeyMatch(KeyStatus.VALID, ClientName("site1"), other)
    assert directory.lookup(other.key.encode(), at_s=0) == KeyMatch(KeyStatus.VALID, ClientName("site1"), other)
    for unknown in (new_key().key, "", b"", b"\xff" * 40, b"\xff" * 32):
        assert directory.lookup(unknown, at_s=150) == KeyMatch(KeyStatus.UNKNOWN)
    keys_now = keys.load_public(tmp_path / "jackal1.pub")
    assert keys_now.valid_at(150) == (old,)
    assert keys_now.valid_at(250) == ()


@pytest.mark.parametrize(
    ("entries", "why"),
    [
        ([(None, 100.0), (None, 200.0)], "the last one expired at 1970-01-01T00:03:20Z"),
        ([(4000.0, None), (3000.0, 5000.0)], "the next one is not valid before 1970-01-01T00:50:00Z"),
        ([(None, 100.0), (3000.0, None)], "the next one is not valid before 1970-01-01T00:50:00Z"),
    ],
)
def test_a_file_of_which_no_key_holds_says_why_and_what_the_clock_says(
    tmp_path: Path, entries: list[tuple[float | None, float | None]], why: str
) -> None:
    """A machine without a battery for its clock begins in the past."""
    path = public(tmp_path, *(new_key(*window) for window in entries), name="relay", file="relay.pub")
    said = f"has no key that is valid now: {why}, and this machine's clock says 1970-01-01T00:16:40Z"
    with pytest.raises(ConfigError) as caught:
        keys.load_server_keys(path, at_s=1000.0)
    assert str(caught.value) == f"{path}: {said}; set the clock, or ask for the relay's new public key"
    assert KeyDirectory(tmp_path).lapsed(at_s=1000.0) == (f"relay {said}: it cannot connect",)


def test_keys_that_hold_now_are_tried_in_the_order_of_the_file(tmp_path: Path) -> None:
    old, new, later = new_key(not_after_s=200.0), new_key(), new_key(not_before_s=300.0)
    path = public(tmp_path, old, later, new)
    assert keys.load_server_keys(path, at_s=100.0) == (old.key, new.key)
    assert keys.load_server_keys(path, at_s=250.0) == (new.key,)
    assert keys.load_server_keys(path, at_s=350.0) == (later.key, new.key)
    assert KeyDirectory(tmp_path).lapsed(at_s=250.0) == ()


@pytest.mark.parametrize("name", ["site1", "jackal1"])
def test_one_key_in_two_files_is_refused(tmp_path: Path, name: str) -> None:
    key = new_key()
    public(tmp_path, key, file="a.pub")
    second = public(tmp_path, key, name=name, file="b.pub")
    with pytest.raises(ConfigError) as caught:
        KeyDirectory(tmp_path)
    assert str(caught.value) == (
        f"{second}: keys: this key of {name} stands also in a.pub as one of jackal1; remove one"
    )


def test_directory_that_is_none(tmp_path: Path) -> None:
    assert KeyDirectory(tmp_path).names == ()
    with pytest.raises(ConfigError, match=r"none: no such directory$"):
        KeyDirectory(tmp_path / "none")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file: is not a directory$"):
        KeyDirectory(tmp_path / "file")
    (tmp_path / ".hidden.pub").touch()
    assert KeyDirectory(tmp_path).warnings == (f"{tmp_path / 'file'}: is not read, its name does not end in .pub",)


def test_keys_are_what_libzmq_uses() -> None:
    pair = keys.generate(NAME)
    assert zmq.curve_public(pair.secret_key.encode()) == pair.public_key.encode()


def test_a_user_id_says_name_and_key() -> None:
    pair = keys.generate(ClientName("robot1"))
    assert keys.parse_user_id(keys.user_id(pair.name, pair.public_key)) == (pair.name, pair.public_key)
    for text in ("", "robot1", f"Robot1 {pair.public_key}", f"robot1 {pair.public_key[1:]}", f" {pair.public_key}"):
        with pytest.raises(UsageError):
            keys.parse_user_id(text)
