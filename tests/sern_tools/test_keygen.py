"""`sern keygen`: two files, never overwritten unasked, and what to do with them."""

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_runtime.config import keys
from sern_tools import keygen


@pytest.mark.parametrize("role", ["relay", "client"])
def test_files_fit_together(tmp_path: Path, role: keygen.Role) -> None:
    text = keygen.run_keygen(role, "hub", out=tmp_path / "new")
    secret, public = keys.load_secret(tmp_path / "new" / "hub.key"), keys.load_public(tmp_path / "new" / "hub.pub")
    assert [key.key for key in public.keys] == [secret.public_key]
    assert keys.secret_warning(tmp_path / "new" / "hub.key") is None
    assert secret.secret_key not in text
    assert "hub.pub" in text and "hub.key" in text


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    (tmp_path / "hub.pub").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"hub\.pub: exists already; --force replaces it"):
        keygen.run_keygen("relay", "hub", out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["hub.pub"]
    keygen.run_keygen("relay", "hub", out=tmp_path, force=True)
    assert keys.load_public(tmp_path / "hub.pub").name == "hub"
    with pytest.raises(UsageError, match="client name 'Hub' must be"):
        keygen.run_keygen("relay", "Hub", out=tmp_path)
    with pytest.raises(ConfigError, match="can not be made"):
        keygen.run_keygen("relay", "hub", out=tmp_path / "hub.pub" / "x")


def test_the_keys_of_a_whole_system(tmp_path: Path) -> None:
    keygen.make_keys(tmp_path / "new", "hub", "robot1", "site")
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*"))
    pairs = ["new/hub.key", "new/hub.pub", "new/robot1.key", "new/site.key"]
    assert found == ["new/clients/robot1.pub", "new/clients/site.pub", *pairs]
    for name, public in (("hub", "hub.pub"), ("robot1", "clients/robot1.pub"), ("site", "clients/site.pub")):
        theirs = keys.load_public(tmp_path / "new" / public)
        mine = keys.load_secret(tmp_path / "new" / f"{name}.key")
        assert (theirs.name, [key.key for key in theirs.keys]) == (name, [mine.public_key])
    with pytest.raises(UsageError, match="client name 'Site' must be"):
        keygen.make_keys(tmp_path / "bad", "hub", "Site")
    assert not (tmp_path / "bad").exists()


def test_command_line_alone_and_inside_another(tmp_path: Path) -> None:
    outer = typer.Typer()
    outer.add_typer(keygen.app, name="keygen")
    runner = CliRunner()
    result = runner.invoke(outer, ["keygen", "client", "jackal1", "--out", str(tmp_path)])
    assert (result.exit_code, result.stderr) == (0, "")
    assert "clients_dir" in result.stdout
    result = runner.invoke(keygen.app, ["client", "jackal1", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert result.stderr == (
        f"{tmp_path / 'jackal1.pub'}: exists already; --force replaces it (and locks out whoever uses it)\n"
    )
    assert runner.invoke(keygen.app, ["relay", "hub", "--out", str(tmp_path)]).exit_code == 0
