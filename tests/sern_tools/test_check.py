"""`sern check`: finds out what a file is, says what it does or what is wrong; and the examples are right."""

import asyncio
import shutil
import sys
from collections import Counter
from io import StringIO
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from sern_client.relay_name import UnresolvedError, resolve
from sern_runtime import ros_installation
from sern_runtime.config import endpoints
from sern_tools import check
from sern_tools.keygen import run_keygen

EXAMPLES = Path(__file__).resolve().parents[2] / "deploy" / "examples"


NO_NAME = "name or service not known"


@pytest.fixture(autouse=True)
def resolver(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that knows no name. The resolver of this machine may hang, and know more names than there are."""

    async def knows_none(_host: str, _port: int) -> str:
        raise UnresolvedError(NO_NAME)

    monkeypatch.setattr(check, "resolve", knows_none)


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
    for name in ("jackal1", "husky1", "j100_0000", "a200_0000", "site1", "twin"):
        run_keygen("client", name, out=tmp_path)
        shutil.copy(tmp_path / f"{name}.pub", tmp_path / "clients")
    return tmp_path


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.name)
def test_examples_are_right(deployed: Path, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endpoints, "installed", lambda _package: True)
    text = (deployed / path.name).read_text()
    (deployed / path.name).write_text(text.replace("tcp://relay.example:", "tcp://127.0.0.1:"))
    code, out, err = ran(deployed / path.name)
    assert (code, err) == (0, "")
    assert out.endswith(f"{path.name}: right\n")


def test_a_relay_that_does_not_resolve_is_a_warning(deployed: Path) -> None:
    code, out, err = ran(deployed / "site.yaml")
    assert (code, err.count("\n")) == (0, 1)
    assert err.startswith(f"warning: {deployed}/site.yaml:")
    assert err.endswith(f"relay.endpoint: relay.example does not resolve on this machine now: {NO_NAME}\n")
    assert out.endswith("site.yaml: right\n")


def test_warnings_stand_where_they_are_seen_after_the_tables(deployed: Path) -> None:
    """A terminal shows its last lines, and the tables of an example are longer than one."""
    terminal = StringIO()
    text = (deployed / "robot.yaml").read_text()
    text = text.replace('match: "/cmd_vel", ', 'match: "cmd_vel", ').replace(", holder: {}", "")
    (deployed / "robot.yaml").write_text(text)
    console = Console(file=terminal, width=200)
    assert check.run_check(deployed / "robot.yaml", out=console, err=console) == 0
    *others, pattern, name, last = terminal.getvalue().splitlines()
    assert pattern.endswith("matches no topic: names begin with '/'; /cmd_vel?")
    assert name.endswith(f"relay.example does not resolve on this machine now: {NO_NAME}")
    assert last == f"{deployed}/robot.yaml: right"
    assert not any("warning" in line for line in others)


async def test_why_a_name_does_not_resolve() -> None:
    """One that no resolver has to be asked about: a label has 63 characters at most."""
    with pytest.raises(UnresolvedError, match="label"):
        await resolve("a" * 64, 5555)
    assert await resolve("127.0.0.1", 5555) == "127.0.0.1"


def test_a_resolver_that_does_not_answer_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    async def asks(_host: str, _port: int) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(check, "resolve", asks)
    monkeypatch.setattr(check, "RESOLVE_S", 0.0)
    problem = check._unresolved("tcp://relay.example:5555")
    assert problem == "relay.example does not resolve on this machine now: no answer within 0 s"


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
            "f.yaml:1: is no client file (client, relay, endpoint), relay file (relay), navigation file (grid) or key "
            "file (did you mean relay?)",
        ),
        ("relay: {name: hub, listen: []}\n", "f.yaml:1: relay.listen: is too short; at least 1 needed"),
        (
            "client: {}\n",
            "f.yaml:1: client.name: is missing\nf.yaml:1: relay: is missing; or write relays, a list of several\n"
            "f.yaml:1: endpoint: is missing",
        ),
        (
            "client: {name: a}\nrelay: {endpoint: 'ipc:///x', insecure: true}\n"
            "endpoint: {kind: ros1, heed_sern: true}\n",
            "f.yaml:3: endpoint.heed_sern: is called accept_bridged now",
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


WAITS = "topics.0.lifespan_s: lets a command wait for up to 120 s, and then a robot moves by it; leave it out, or "
HERE = "client: {name: jackal1}\nrelay: {endpoint: 'tcp://127.0.0.1:5555', insecure: true}\n"
ENDPOINT = "endpoint: {kind: synthetic, role: robot}\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            ENDPOINT + "topics:\n  - {match: /cmd_vel, class: control, lifespan_s: 120}\n",
            "5: topics.0.lifespan_s: lets a command wait for up to 120 s, and then a robot moves by it; leave it out, "
            "or write a second or less",
        ),
        (
            ENDPOINT + "topics:\n  - {match: /cmd_vel, class: control, lifespan_s: null}\n",
            "5: topics.0.lifespan_s: lets a command wait for ever, and then a robot moves by it; leave it out, or "
            "write a second or less",
        ),
        *(
            (ENDPOINT + f"topics:\n  - {{{rule}, lifespan_s: 120}}\n", f"5: {WAITS}write a second or less")
            for rule in (
                "match: /robot/cmd_vel",
                "match: '.*/joy_teleop', class: state",
                "match: /drive, on_link_loss: {publish: zero, after_s: 0.5}",
                "match: /drive, type: geometry_msgs/Twist",
                "match: /drive, type: 'geometry_msgs/(msg/)?Twist(Stamped)?'",
                "match: /drive, class: state, type: ackermann_msgs/msg/AckermannDrive",
                "match: /drive, type: 'ackermann_msgs/AckermannDrive.*'",
            )
        ),
        *(
            (ENDPOINT + f"topics:\n  - {{{rule}, lifespan_s: 120}}\n", "")
            for rule in (
                "match: /map, type: 'nav_msgs/.*'",
                "match: '.*', type: 'geometry_msgs/.*'",  # whatever there is
                "match: /velocity, type: geometry_msgs/TwistWithCovarianceStamped",  # where it is, not where it shall
            )
        ),
        (ENDPOINT + "topics:\n  - {match: /stop, class: control, reliability: reliable, lifespan_s: null}\n", ""),
        (ENDPOINT + "topics:\n  - {match: /map, class: state, lifespan_s: 600}\n", ""),
        (
            ENDPOINT + "topics:\n  - {match: cmd_vel}\n",
            "5: topics.0.match: 'cmd_vel' matches no topic: names begin with '/'; /cmd_vel?",
        ),
        (
            ENDPOINT + "subscribe: ['[a-z]+/odom']\n",
            "4: subscribe.0: '[a-z]+/odom' matches no topic: names begin with '/'",
        ),
        (ENDPOINT + "subscribe: ['.*odom', '(/a|b)/c', '[^a]b', '/?odom']\n", ""),
        (
            ENDPOINT + "discovery: {deny: [rosout]}\n",
            "4: discovery.deny.0: 'rosout' matches no topic: names begin with '/'; /rosout?",
        ),
        (
            ENDPOINT + "discovery: {allow: ['/odom', odom]}\n",
            "4: discovery.allow.1: 'odom' matches no topic: names begin with '/'; /odom?",
        ),
        *(
            (
                ENDPOINT + f"{key}:\n  {word}:\n    - match: move_base\n",
                f"6: {key}.{word}.0.match: 'move_base' matches no topic: names begin with '/'; /move_base?",
            )
            for key in ("services", "actions")
            for word in ("offer", "use")
        ),
        (
            "endpoint: {kind: bag, path: f.yaml, topics: [odom]}\n",
            "3: endpoint.topics.0: 'odom' matches no topic: names begin with '/'; /odom?",
        ),
        (
            "endpoint:\n- {kind: synthetic, role: robot}\n- {kind: bag, path: f.yaml, deny: ['/a', 'camera/.*']}\n",
            "5: endpoint.1.deny.1: 'camera/.*' matches no topic: names begin with '/'; /camera/.*?",
        ),
        (
            "endpoint: {kind: zenoh}\n",
            "3: endpoint.kind: needs the Python package zenoh, which is not on this machine: "
            f"{sys.executable} -m pip install eclipse-zenoh",
        ),
        (
            "endpoint: {kind: dds}\n",
            "3: endpoint.kind: needs the Python package cyclonedds, which is not on this machine: "
            f"{sys.executable} -m pip install cyclonedds==11.0.1",
        ),
        (
            "endpoint: {kind: rclpy}\n",
            "3: endpoint.kind: needs the Python package rclpy, which is not on this machine: "
            f"{ros_installation.remedy()}",
        ),
        (
            "endpoint: {kind: synthetic, role: robot, plant: mujoco}\n",
            "3: endpoint.plant: needs the Python package mujoco, which is not on this machine: "
            f"{sys.executable} -m pip install mujoco",
        ),
        ("endpoint: {kind: synthetic, role: robot, plant: unicycle}\n", ""),
    ],
)
def test_what_is_accepted_and_does_not_do_what_it_seems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, said: str
) -> None:
    monkeypatch.setattr(endpoints, "installed", lambda _package: False)
    path = tmp_path / "f.yaml"
    path.write_text(HERE + text, encoding="utf-8")
    code, _, err = ran(path)
    assert (code, err) == (0, said and f"warning: {path}:{said}\n")


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("{kind: rclpy, services_only: true}", True),
        ("[{kind: rclpy, services_only: true}, {kind: rclpy, domain: 1, services_only: true}]", True),
        ("[{kind: dds}, {kind: rclpy, services_only: true}]", False),
        ("{kind: rclpy}", False),
    ],
)
def test_topics_that_nobody_takes_are_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, endpoint: str, said: bool
) -> None:
    monkeypatch.setattr(endpoints, "installed", lambda _package: True)
    path = tmp_path / "f.yaml"
    path.write_text(f"{HERE}endpoint: {endpoint}\n", encoding="utf-8")
    code, _, err = ran(path)
    problem = (
        f"warning: {path}:3: endpoint: services_only leaves topics to another endpoint, such as one of kind dds, and "
        "there is none\n"
    )
    assert (code, err) == (0, problem if said else "")


def test_a_package_that_is_there_is_found() -> None:
    assert endpoints.installed("zmq") and not endpoints.installed("no_such_package")


def test_patterns_and_commands_of_a_relay(deployed: Path) -> None:
    path = deployed / "relay.yaml"
    path.write_text(path.read_text().replace("publish: ['/{self}/.*', ", "publish: ['{self}/.*', "))
    code, _, err = ran(path)
    assert code == 0
    assert "publish.0: '{self}/.*' matches no topic: names begin with '/'" in err
    assert err.count("warning") == 1


ROLE = "{name: scene, publish_endpoint: 'ipc://@scene/out', ingest_endpoint: 'ipc://@scene/in', allow_control: true, "


@pytest.mark.parametrize(
    ("role", "said"),
    [
        ("subscribe: [odom], publish: [/a]", "subscribe.0: 'odom' matches no topic: names begin with '/'; /odom?"),
        ("publish: [/a, scene/.*]", "publish.1: 'scene/.*' matches no topic: names begin with '/'; /scene/.*?"),
        (
            "publish: [/a], types: [{match: goal, type: geometry_msgs/PoseStamped}]",
            "types.0.match: 'goal' matches no topic: names begin with '/'; /goal?",
        ),
        (
            "publish: [/a], types: [{match: /a, type: geometry_msgs/Twist, lifespan_s: 120}]",
            "types.0." + WAITS.partition(".0.")[2] + "write a second or less",
        ),
        ("subscribe: [/odom], publish: [/a], types: [{match: /a, type: geometry_msgs/Twist}]", ""),
    ],
)
def test_patterns_and_commands_of_the_roles_of_a_feed(tmp_path: Path, role: str, said: str) -> None:
    path = tmp_path / "relay.yaml"
    relay = "relay: {name: hub, listen: ['tcp://127.0.0.1:5555'], insecure: true}\n"
    path.write_text(f"{relay}feed:\n  roles:\n    - {ROLE}{role}}}\n", encoding="utf-8")
    code, _, err = ran(path)
    assert (code, err) == (0, said and f"warning: {path}:4: feed.roles.0.{said}\n")


def test_key_files_with_the_name_of_somebody_else(deployed: Path) -> None:
    clients = deployed / "clients"
    shutil.move(clients / "husky1.pub", clients / "jackal2.pub")
    shutil.move(clients / "site1.pub", clients / "site1-2030.pub")  # several files may be of one client
    odd = (
        f"{clients}/jackal2.pub holds the key of husky1, and by its name that of jackal2: who has it connects as husky1"
    )
    code, _, err = ran(deployed / "relay.yaml")
    assert (code, err.count("\n")) == (0, 1)
    assert err.endswith(f"relay.clients_dir: {odd}\n")
    code, out, err = ran(clients / "jackal2.pub")
    assert (code, err) == (0, f"warning: {odd}\n")
    assert out == f"public key file of husky1, 1 key(s)\n{clients}/jackal2.pub: right\n"
    site = deployed / "site.yaml"
    site.write_text(site.read_text().replace("relay.example", "127.0.0.1").replace("relay.pub", "site1.pub"))
    shutil.copy(deployed / "jackal1.pub", deployed / "site1.pub")
    code, _, err = ran(site)
    assert code == 0
    assert f"relay.secret_key_file: {deployed}/site1.pub is not its public half (it holds the key of jackal1)" in err
    run_keygen("client", "site1", out=deployed, force=True)
    code, _, err = ran(site)
    assert f"relay.server_key_file: {deployed}/site1.pub is the key of site1, this client; the relay's is needed" in err
    assert err.count("warning") == 1


def windowed(path: Path, window: str) -> None:
    """Give the only key of a public key file a window."""
    path.write_text(f"{path.read_text()}    {window}\n")


def test_a_relay_whose_keys_do_not_hold_is_an_error_as_at_the_start(deployed: Path) -> None:
    windowed(deployed / "relay.pub", 'not_after: "2020-01-01T00:00:00Z"')
    expired = (
        "has no key that is valid now: the last one expired at 2020-01-01T00:00:00Z, and this machine's clock says"
    )
    code, _, err = ran(deployed / "site.yaml")
    assert (code, err.count("\n")) == (2, 1)
    assert f"relay.server_key_file: {deployed}/relay.pub: {expired}" in err
    code, _, err = ran(deployed / "relay.pub")
    assert code == 0
    assert err.startswith(f"warning: {deployed}/relay.pub {expired}")


def test_a_client_whose_keys_do_not_hold_is_a_warning_at_the_relay(deployed: Path) -> None:
    windowed(deployed / "clients" / "jackal1.pub", 'not_before: "2999-01-01T00:00:00Z"')
    code, out, err = ran(deployed / "relay.yaml")
    assert (code, err.count("\n")) == (0, 1)
    later = "jackal1 has no key that is valid now: the next one is not valid before 2999-01-01T00:00:00Z, and this "
    assert f"relay.clients_dir: {later}machine's clock says 2" in err
    assert err.endswith(": it cannot connect\n")
    assert out.endswith("relay.yaml: right\n")


def test_a_client_that_a_rule_names_and_that_has_no_key_is_a_warning(deployed: Path) -> None:
    (deployed / "clients" / "site1.pub").unlink()
    (deployed / "clients" / "husky1.pub").unlink()  # its rule is for many
    code, _, err = ran(deployed / "relay.yaml")
    assert (code, err.count("\n")) == (0, 1)
    assert err.endswith(f"access.0.client: no .pub file in {deployed}/clients is of site1: it cannot connect\n")


def test_a_narrow_terminal_shows_every_pattern_whole(deployed: Path) -> None:
    wide, narrow = StringIO(), StringIO()
    for file, width in ((wide, 1000), (narrow, 60)):
        assert check.run_check(deployed / "relay.yaml", out=Console(file=file, width=width)) == 0
    letters = [Counter(file.getvalue().replace("\n", "").replace(" ", "")) for file in (wide, narrow)]
    assert letters[0] == letters[1]
    assert "…" not in narrow.getvalue()


def test_command_line_alone_and_inside_another(deployed: Path) -> None:
    outer = typer.Typer()
    outer.add_typer(check.app, name="check")
    runner = CliRunner()
    assert runner.invoke(outer, ["check", str(deployed / "site.yaml")]).exit_code == 0
    result = runner.invoke(check.app, [str(deployed / "none.yaml")])
    assert (result.exit_code, result.stdout, result.stderr) == (2, "", f"{deployed}/none.yaml: no such file\n")


def test_a_navigation_file_is_read_where_its_packages_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "navigation.yaml"
    path.write_text("endpoint: {kind: ros1}\ngrid: {west_m: 0, south_m: 0, width_m: 4, length_m: 4}\n")
    assert check.run_check(path) == check.EXIT_OK
    assert "navigation at endpoint ros1" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "sern_runtime.config.navigation", None)
    assert check.run_check(path) == check.EXIT_USER_ERROR
    assert "to read one needs more packages" in capsys.readouterr().err
