"""`sern check`: finds out what a file is, says what it does or what is wrong; and the examples are right."""

import shutil
from io import StringIO
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from sern_tools import check
from sern_tools.keygen import run_keygen

EXAMPLES = Path(__file__).resolve().parents[2] / "deploy" / "examples"


def ran(path: Path) -> tuple[int, str, str]:
    out, err = StringIO(), StringIO()
    code = check.run_check(path, out=Console(file=out, width=200), err=Console(file=err, width=200))
    return code, out.getvalue(), err.getvalue()


@pytest.fixture
def deployed(tmp_path: Path) -> Path:
    """The examples with keys, as keygen's advice says."""
    shutil.copytree(EXAMPLES, tmp_path, dirs_exist_ok=True)
    (tmp_path / "clients").mkdir()
    run_keygen("relay", "relay", out=tmp_path)
    for name in ("jackal1", "husky1", "j100_0000", "a200_0000", "site1"):
        run_keygen("client", name, out=tmp_path)
        shutil.copy(tmp_path / f"{name}.pub", tmp_path / "clients")
    return tmp_path


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.name)
def test_examples_are_right(deployed: Path, path: Path) -> None:
    text = (deployed / path.name).read_text()
    (deployed / path.name).write_text(text.replace("tcp://relay.example:", "tcp://127.0.0.1:"))
    code, out, err = ran(deployed / path.name)
    assert (code, err) == (0, "")
    assert out.endswith(f"{path.name}: right\n")


def test_a_relay_that_does_not_resolve_is_a_warning(deployed: Path) -> None:
    code, out, err = ran(deployed / "site.yaml")  # its relay is in .example, which nobody has (RFC 2606)
    assert (code, err.count("\n")) == (0, 1)
    assert err.startswith(f"warning: {deployed}/site.yaml:")
    assert "relay.endpoint: relay.example does not resolve on this machine now: " in err
    assert out.endswith("site.yaml: right\n")


def test_there_are_examples() -> None:
    assert {path.name for path in EXAMPLES.glob("*.yaml")} >= {"relay.yaml", "robot.yaml", "site.yaml"}


@pytest.mark.parametrize(
    ("name", "said"),
    [("jackal1.key", "secret key file of jackal1"), ("jackal1.pub", "public key file of jackal1, 1 key(s)")],
)
def test_key_files(deployed: Path, name: str, said: str) -> None:
    code, out, err = ran(deployed / name)
    assert (code, err) == (0, "")
    assert out.startswith(said)


def test_summary_names_what_matters(deployed: Path) -> None:
    _, out, _ = ran(deployed / "robot.yaml")
    assert "client jackal1, namespace /jackal1" in out
    assert "relay tcp://relay.example:5555 (CURVE)" in out
    assert "subscribes to /jackal1(?:/cmd_vel)" in out
    _, out, _ = ran(deployed / "relay.yaml")
    assert "listens on tcp://0.0.0.0:5555 (CURVE)" in out
    assert "(jackal|husky)[0-9]+" in out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "a: [1\n",
            "f.yaml:2: not valid YAML: while parsing a flow sequence, expected ',' or ']', but got '<stream end>'",
        ),
        (
            "relai: {}\n",
            "f.yaml:1: is no client file (client, relay, endpoint), relay file (relay) or key file "
            "(did you mean relay?)",
        ),
        ("relay: {name: hub, listen: []}\n", "f.yaml:1: relay.listen: is too short; at least 1 needed"),
        (
            "client: {}\n",
            "f.yaml:1: client.name: is missing\nf.yaml:1: relay: is missing\nf.yaml:1: endpoint: is missing",
        ),
        (
            "sern_key: open\n",
            "f.yaml:1: sern_key: is not accepted as it is; accepted: public, secret",
        ),
    ],
)
def test_errors_are_lines_and_exit_code_2(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "f.yaml"
    path.write_text(text, encoding="utf-8")
    code, out, err = ran(path)
    assert (code, out) == (2, "")
    assert err == said.replace("f.yaml", str(path)) + "\n"


def test_missing_file_and_missing_keys(tmp_path: Path) -> None:
    assert ran(tmp_path / "none.yaml") == (2, "", f"{tmp_path}/none.yaml: no such file\n")
    shutil.copy(EXAMPLES / "robot.yaml", tmp_path)
    code, out, err = ran(tmp_path / "robot.yaml")
    assert (code, out) == (2, "")
    assert [line.rsplit("/", 1)[1] for line in err.splitlines()] == [
        "relay.pub: no such file",
        "jackal1.key: no such file",
    ]


def test_warnings_go_to_standard_error(deployed: Path) -> None:
    (deployed / "site1.key").chmod(0o644)
    for name in ("site.yaml", "site1.key"):
        code, _, err = ran(deployed / name)
        assert code == 0
        assert err.startswith("warning: ") and "chmod 600" in err


def test_command_line_alone_and_inside_another(deployed: Path) -> None:
    outer = typer.Typer()
    outer.add_typer(check.app, name="check")
    runner = CliRunner()
    assert runner.invoke(outer, ["check", str(deployed / "site.yaml")]).exit_code == 0
    result = runner.invoke(check.app, [str(deployed / "none.yaml")])
    assert (result.exit_code, result.stdout, result.stderr) == (2, "", f"{deployed}/none.yaml: no such file\n")
