"""Who may come in, by a directory of keys, and what is told when one is taken away."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_core.vocabulary.types import ClientName
from sern_relay.admission import Admission, read_directory
from sern_runtime.config.keys import KeyStatus, SecretKey, generate, user_id
from sern_runtime.zap import Refusal, TemporaryRefusal

ROBOT, OTHER = ClientName("robot1"), ClientName("robot2")


def public(folder: Path, key: SecretKey, **window: str) -> None:
    folder.mkdir(exist_ok=True)
    lines = "".join(f'\n    {edge}: "{at}"' for edge, at in window.items())
    text = f'sern_key: public\nname: {key.name}\nkeys:\n  - public_key: "{key.public_key}"{lines}\n'
    (folder / f"{key.name}.pub").write_text(text)


def test_who_holds_a_key_is_admitted_by_its_name_and_nobody_else(tmp_path: Path) -> None:
    ours, strange = generate(ROBOT), generate(OTHER)
    public(tmp_path / "clients", ours)
    admission = Admission(read_directory(tmp_path / "clients"))
    assert admission.known(ROBOT) and not admission.known(OTHER)
    assert admission.lookup(ours.public_key, "10.0.0.1") == user_id(ROBOT, ours.public_key)
    assert admission.lookup(strange.public_key, "10.0.0.1") is None
    assert admission.status(ROBOT, ours.public_key) is KeyStatus.VALID
    assert admission.status(OTHER, ours.public_key) is KeyStatus.UNKNOWN


def test_a_key_outside_its_time_is_refused_with_the_reason(tmp_path: Path) -> None:
    early, late = generate(ROBOT), generate(OTHER)
    public(tmp_path / "clients", early, not_before="2999-01-01T00:00:00Z")
    public(tmp_path / "clients", late, not_after="2001-01-01T00:00:00Z")
    admission = Admission(read_directory(tmp_path / "clients"))
    soon, gone = admission.lookup(early.public_key, ""), admission.lookup(late.public_key, "")
    assert isinstance(soon, TemporaryRefusal) and "robot1" in soon.reason
    assert isinstance(gone, Refusal) and "robot2" in gone.reason


def test_what_a_new_directory_takes_away_is_told_once(tmp_path: Path) -> None:
    old, new = generate(ROBOT), generate(ROBOT)
    public(tmp_path / "before", old)
    public(tmp_path / "before", generate(OTHER))
    admission = Admission(read_directory(tmp_path / "before"))
    assert admission.take_lapsed() == {}
    public(tmp_path / "after", new)
    admission.replace(read_directory(tmp_path / "after"))
    lapsed = admission.take_lapsed()
    assert list(lapsed) == [ROBOT, OTHER] and lapsed[ROBOT] == {old.public_key}
    assert admission.take_lapsed() == {}
    assert admission.valid()[ROBOT] == {new.public_key}
    assert not admission.known(OTHER)


def test_without_a_directory_everybody_may_come(tmp_path: Path) -> None:
    admission = Admission(read_directory(None))
    assert admission.known(ROBOT) and admission.status(ROBOT, "any") is KeyStatus.VALID
    assert admission.take_lapsed() == {}
    with pytest.raises(ConfigError, match="nowhere"):
        read_directory(tmp_path / "nowhere")
