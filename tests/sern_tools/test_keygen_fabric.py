"""`sern keygen fabric`: an authority and its relays, nothing overwritten, secrets for their owner alone."""

import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from typer.testing import CliRunner

from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_tools import keygen
from sern_tools.keygen_fabric import add_relays, make_fabric


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_authority_and_its_relays(tmp_path: Path) -> None:
    text = make_fabric(["hub1", "hub2"], out=tmp_path / "new")
    add = add_relays(["hub3"], out=tmp_path / "new")
    assert "relays: [hub2]" in text and "hub3.pem" in add
    found = sorted(path.name for path in (tmp_path / "new").iterdir())
    relays = [name for relay in ("hub1", "hub2", "hub3") for name in (f"{relay}-key.pem", f"{relay}.pem")]
    assert found == ["ca-key.pem", "ca.pem", *relays]
    authority = x509.load_pem_x509_certificate((tmp_path / "new" / "ca.pem").read_bytes())
    for relay in ("hub1", "hub2", "hub3"):
        certificate = x509.load_pem_x509_certificate((tmp_path / "new" / f"{relay}.pem").read_bytes())
        certificate.verify_directly_issued_by(authority)
        assert [name.value for name in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] == [relay]
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert names.get_values_for_type(x509.DNSName) == [relay]
        key = certificate.public_key()
        assert isinstance(key, ec.EllipticCurvePublicKey) and isinstance(key.curve, ec.SECP256R1)
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        assert certificate.not_valid_after_utc <= authority.not_valid_after_utc
    for path in (tmp_path / "new").glob("*-key.pem"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert path.read_text().splitlines()[1] not in text


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    make_fabric(["hub1"], out=tmp_path)
    before = contents(tmp_path)
    with pytest.raises(ConfigError, match=r"ca\.pem: exists already, and is not replaced; --relay NAME adds"):
        make_fabric(["hub2"], out=tmp_path)
    with pytest.raises(ConfigError, match=r"hub1\.pem: exists already, and is not replaced; move it away"):
        add_relays(["hub2", "hub1"], out=tmp_path)
    assert contents(tmp_path) == before


def test_what_is_wrong_is_one_line(tmp_path: Path) -> None:
    for names, said in (
        (["Hub"], "client name 'Hub' must be"),
        ([], "name the relays"),
        (["ca"], "ca is the name of the authority's files"),
        (["hub1", "hub1"], "hub1 is named twice"),
    ):
        with pytest.raises(UsageError, match=said):
            make_fabric(names, out=tmp_path / "new")
    assert not (tmp_path / "new").exists()
    with pytest.raises(ConfigError, match=r"ca\.pem: can not be read: No such file.*; sern keygen fabric NAME"):
        add_relays(["hub1"], out=tmp_path)
    make_fabric(["hub1"], out=tmp_path)
    (tmp_path / "ca-key.pem").write_bytes((tmp_path / "hub1-key.pem").read_bytes())
    with pytest.raises(ConfigError, match=r"ca-key\.pem: is not the key of"):
        add_relays(["hub2"], out=tmp_path)
    (tmp_path / "ca-key.pem").write_text("nothing")
    with pytest.raises(ConfigError, match=r"ca-key\.pem: is no certificate or key"):
        add_relays(["hub2"], out=tmp_path)
    with pytest.raises(ConfigError, match="can not be made"):
        make_fabric(["hub1"], out=tmp_path / "ca.pem" / "x")


def test_command_line(tmp_path: Path) -> None:
    runner = CliRunner()
    out = ["--out", str(tmp_path)]
    made = runner.invoke(keygen.app, ["fabric", "hub1", "hub2", *out])
    assert (made.exit_code, made.stderr) == (0, "")
    assert runner.invoke(keygen.app, ["fabric", "--relay", "hub3", *out]).exit_code == 0
    again = runner.invoke(keygen.app, ["fabric", "hub1", *out])
    assert again.exit_code == 2 and "ca.pem: exists already" in again.stderr
    both = runner.invoke(keygen.app, ["fabric", "hub4", "--relay", "hub5", *out])
    assert both.exit_code == 2 and "not both" in both.stderr
