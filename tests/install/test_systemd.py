"""The units under a real systemd, with the package installed: relay, robot and site as the guide sets them up.

One machine boots for all of these tests; each finds the daemons running and leaves them running.
"""

import csv
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.install.machine import Machine
from tests.install.test_package import install, newer

RELAY: Final = "sern-relay.service"
ROBOT: Final = "sern-client.service"
SITE: Final = "sern-client@site1.service"
UNITS: Final = (RELAY, ROBOT, SITE)
DOC: Final = "/usr/share/doc/sern/examples"
LOGGED: Final = '\nmessage_log: "/var/lib/sern/{}.csv"\n'
RELIABLE: Final = (
    '  - {match: ".*odom.*|.*/imu/data", class: state, direction: send, reliability: reliable, depth: 5000}\n'
)


ENDPOINTS: Final = {
    "ros1": "{kind: ros1, master_uri: 'http://127.0.0.1:11311', host: 127.0.0.1}",
    "dds": "{kind: dds, domain: 0, interface: lo}",
    "zenoh": "{kind: zenoh, listen: ['tcp/127.0.0.1:7447']}",
    "foxglove": "{kind: foxglove, listen: '127.0.0.1:8765'}",
    "unity": "{kind: unity, listen: '127.0.0.1:10000'}",
}
"""One of each kind that speaks over a network. The master of ROS 1 is not there: it looks for it."""
CLIENT: Final = """
client: {{name: {name}}}
relay: {{endpoint: "tcp://127.0.0.1:5555", server_key_file: relay.pub, secret_key_file: {name}.key}}
endpoint: {endpoint}
subscribe: ["/jackal1/(cmd_vel|odometry/filtered)"]
http: {{listen: null}}
"""


def ask(machine: Machine, *command: str) -> str:
    """A command of a person who has become the user of the daemons."""
    return machine.run("setpriv", "--reuid=sern", "--regid=sern", "--clear-groups", *command).stdout


def put(machine: Machine, name: str, text: str) -> None:
    """A file in /etc/sern, the daemons' own."""
    path = machine.root / "etc/sern" / name
    path.write_text(text)
    machine.run("chown", "sern:sern", f"/etc/sern/{name}")
    machine.run("chmod", "0600", f"/etc/sern/{name}")


def configure(machine: Machine) -> None:
    """Sections 2 to 5 of deploy/README.md, all three on one host. The robot's busiest topics are reliable."""
    examples = machine.root / DOC.lstrip("/")
    ask(machine, "sern", "keygen", "relay", "relay", "--out", "/etc/sern")
    ask(machine, "mkdir", "/etc/sern/clients")
    for name in ("jackal1", "site1"):
        ask(machine, "sern", "keygen", "client", name, "--out", "/etc/sern")
        ask(machine, "cp", f"/etc/sern/{name}.pub", "/etc/sern/clients/")
    put(machine, "relay.yaml", (examples / "relay.yaml").read_text())
    robot = (examples / "robot.yaml").read_text().replace("relay.example", "127.0.0.1")
    robot = re.sub(r"^topics:\n", lambda found: found[0] + RELIABLE, robot, flags=re.M)
    put(machine, "client.yaml", robot + LOGGED.format("robot"))
    site = (examples / "site.yaml").read_text().replace("relay.example", "127.0.0.1")
    ask(machine, "mkdir", "/var/lib/sern/site1")  # systemd would make it at the first start; `sern check` looks for it
    put(machine, "site1.yaml", site.replace('path: "."', "path: /var/lib/sern/site1") + LOGGED.format("site1/site"))
    for name in ("relay", "client", "site1"):
        assert ask(machine, "sern", "check", f"/etc/sern/{name}.yaml").splitlines()[-1].endswith("right")


def together(machine: Machine) -> None:
    """Wait until both clients have their sessions."""
    machine.until_shown(RELAY, "StatusText", lambda text: text.startswith("2 clients"))
    for unit in (ROBOT, SITE):
        machine.until_shown(unit, "StatusText", lambda text: text == "link up")


@pytest.fixture(scope="module")
def machine(root: Path, sern_package: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    install(root, sern_package)
    with Machine(root, tmp_path_factory.mktemp("machine") / "console") as machine:
        configure(machine)
        # `start` of Type=notify returns when the daemon has said READY, and not before.
        machine.run("systemctl", "enable", "--now", RELAY, ROBOT, SITE)
        together(machine)
        yield machine


def test_they_are_ready_and_say_how_it_is(machine: Machine) -> None:
    for unit in UNITS:
        assert [machine.show(unit, key) for key in ("ActiveState", "SubState", "Type", "NRestarts", "Result")] == [
            "active", "running", "notify", "0", "success",
        ]  # fmt: skip
        assert machine.show(unit, "WatchdogTimestampMonotonic") != "0", "it pings"
    assert re.fullmatch(r"2 clients, \d+ streams", machine.show(RELAY, "StatusText"))
    status = machine.run("systemctl", "status", "--no-pager", "--lines=0", ROBOT).stdout
    assert 'Status: "link up"' in status


def test_they_run_as_little_as_the_units_say(machine: Machine) -> None:
    """The kernel's own account of the processes, and systemd's of the units as they are loaded."""
    for unit in UNITS:
        lines = machine.run("cat", f"/proc/{machine.show(unit, 'MainPID')}/status").stdout.splitlines()
        status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
        assert {key: status[key] for key in ("NoNewPrivs", "CapEff", "CapBnd", "Seccomp")} == {
            "NoNewPrivs": "1", "CapEff": "0" * 16, "CapBnd": "0" * 16, "Seccomp": "2",
        }  # fmt: skip
        assert machine.run("id", "-u", "sern").stdout.strip() in status["Uid"].split()
        machine.run("systemd-analyze", "security", "--threshold=15", "--no-pager", unit)
        denied = [line for line in machine.journal(unit) if "not permitted" in line or "Permission denied" in line]
        assert denied == []


def test_reload_takes_what_is_right_and_keeps_the_old_for_what_is_not(machine: Machine) -> None:
    before = [machine.show(unit, "MainPID") for unit in UNITS]
    ask(machine, "sern", "keygen", "client", "laptop1", "--out", "/etc/sern")
    ask(machine, "cp", "/etc/sern/laptop1.pub", "/etc/sern/clients/")
    good = (machine.root / "etc/sern/relay.yaml").read_text()
    put(
        machine,
        "relay.yaml",
        good.replace("access:\n", "access:\n  - {client: laptop1, subscribe: ['/jackal1/.*']}\n", 1),
    )
    machine.run("systemctl", "reload", RELAY)
    echo = ("sern", "echo", "/jackal1/odometry/filtered", "--relay", "tcp://127.0.0.1:5555",
            "--key", "/etc/sern/laptop1.key", "--server-key", "/etc/sern/relay.pub", "--count", "1")  # fmt: skip
    assert "child_frame_id" in ask(machine, *echo)

    put(machine, "relay.yaml", "relay: {name: relay")
    machine.run("systemctl", "reload", RELAY)
    machine.until_shown(RELAY, "StatusText", lambda text: "reload failed, the old configuration stays: " in text)
    assert "2 clients" in machine.show(RELAY, "StatusText")
    assert "child_frame_id" in ask(machine, *echo), "the rules of before are in force"
    put(machine, "relay.yaml", good)
    machine.run("systemctl", "reload", RELAY)
    machine.until_shown(RELAY, "StatusText", lambda text: "reload failed" not in text)

    for unit in (ROBOT, SITE):
        machine.run("systemctl", "reload", unit)
        machine.until_shown(unit, "ActiveState", lambda text: text == "active")
    together(machine)
    assert [machine.show(unit, "MainPID") for unit in UNITS] == before
    assert {machine.show(unit, "NRestarts") for unit in UNITS} == {"0"}


@pytest.mark.parametrize("unit", UNITS)
def test_one_that_hangs_is_restarted_by_the_watchdog(machine: Machine, unit: str) -> None:
    pid, restarts = machine.show(unit, "MainPID"), int(machine.show(unit, "NRestarts"))
    machine.run("kill", "-STOP", pid)
    machine.until_shown(unit, "NRestarts", lambda text: int(text) > restarts)
    assert any("Watchdog timeout" in line for line in machine.journal(unit))
    machine.until_shown(unit, "SubState", lambda text: text == "running")
    assert machine.show(unit, "MainPID") not in {pid, "0"}
    together(machine)


@pytest.mark.parametrize("unit", UNITS)
def test_one_that_is_killed_is_restarted(machine: Machine, unit: str) -> None:
    pid, restarts = machine.show(unit, "MainPID"), int(machine.show(unit, "NRestarts"))
    machine.run("kill", "-KILL", pid)
    machine.until_shown(unit, "NRestarts", lambda text: int(text) == restarts + 1)
    machine.until_shown(unit, "SubState", lambda text: text == "running")
    together(machine)


def seqs(machine: Machine, log: str, event: str) -> Counter[tuple[str, str]]:
    """(topic, seq) of the reliable messages in a message log that ended in this way there."""
    with (machine.root / "var/lib/sern" / log).open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["event"] == event and row["class"] == "state"]
    return Counter((row["topic"], row["seq"]) for row in rows if re.search("odom|imu/data", row["topic"]))


def test_a_stop_under_load_is_drained(machine: Machine) -> None:
    """Every reliable message that the robot took is at the site when the unit has stopped."""
    for unit in (ROBOT, SITE):
        machine.run("systemctl", "restart", unit)
    together(machine)
    machine.until_shown(ROBOT, "ActiveState", lambda _: len(seqs(machine, "robot.csv", "offered")) > 1000)
    machine.run("systemctl", "stop", ROBOT)
    assert [machine.show(ROBOT, key) for key in ("ActiveState", "Result", "ExecMainStatus")] == [
        "inactive", "success", "0",
    ]  # fmt: skip
    offered = seqs(machine, "robot.csv", "offered")
    machine.run("systemctl", "stop", SITE)
    delivered = seqs(machine, "site1/site.csv", "delivered")
    # What the robot published before the site had subscribed is not owed to it.
    first = {topic: min(int(seq) for name, seq in delivered if name == topic) for topic, _ in delivered}
    owed = {(topic, seq) for topic, seq in offered if int(seq) >= first[topic]}
    assert len(owed) > 500
    assert (owed - set(delivered), max(delivered.values())) == (set(), 1)
    # The relay, with its clients there.
    machine.run("systemctl", "start", ROBOT, SITE)
    together(machine)
    machine.run("systemctl", "stop", RELAY)
    assert [machine.show(RELAY, key) for key in ("ActiveState", "Result", "ExecMainStatus")] == [
        "inactive", "success", "0",
    ]  # fmt: skip
    machine.run("systemctl", "start", RELAY)
    together(machine)


def test_a_secret_key_can_be_a_credential(machine: Machine) -> None:
    """The drop-in of the guide: the file is root's alone, the daemon sees a copy that nobody else can read."""
    good = (machine.root / "etc/sern/relay.yaml").read_text()
    drop_in = machine.root / "etc/systemd/system/sern-relay.service.d/credential.conf"
    drop_in.parent.mkdir(parents=True)
    source = machine.root / DOC.lstrip("/") / "systemd/sern-relay-credential.conf"
    drop_in.write_text(source.read_text())
    machine.run("install", "-d", "-m", "0700", "/etc/sern-keys")
    machine.run("install", "-m", "0600", "/etc/sern/relay.key", "/etc/sern-keys/relay.key")
    machine.run("mv", "/etc/sern/relay.key", "/root/relay.key")
    put(
        machine,
        "relay.yaml",
        re.sub(r"secret_key_file: .*", "secret_key_file: /run/credentials/sern-relay.service/relay.key", good),
    )
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "restart", RELAY)
    together(machine)
    assert not any("open to others" in line for line in machine.journal(RELAY))
    machine.run("systemctl", "reload", RELAY)
    machine.until_shown(RELAY, "StatusText", lambda text: "reload failed" not in text and text.startswith("2 clients"))
    machine.run("mv", "/root/relay.key", "/etc/sern/relay.key")
    drop_in.unlink()
    put(machine, "relay.yaml", good)
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "restart", RELAY)
    together(machine)


@pytest.mark.parametrize("kind", ENDPOINTS)
def test_every_middleware_runs_with_as_little(machine: Machine, kind: str) -> None:
    """Libraries that are not ours, with threads of their own, behind the list of system calls."""
    name, unit = f"{kind}1", f"sern-client@{kind}1.service"
    ask(machine, "sern", "keygen", "client", name, "--out", "/etc/sern")
    ask(machine, "cp", f"/etc/sern/{name}.pub", "/etc/sern/clients/")
    machine.run("systemctl", "reload", RELAY)
    put(machine, f"{name}.yaml", CLIENT.format(name=name, endpoint=ENDPOINTS[kind]))
    machine.run("systemctl", "start", unit)
    machine.until_shown(unit, "StatusText", lambda text: text == "link up")
    said = machine.journal(unit)
    assert [line for line in said if "not permitted" in line or "Permission denied" in line] == []
    machine.run("systemctl", "stop", unit)
    assert [machine.show(unit, key) for key in ("Result", "NRestarts", "ExecMainStatus")] == ["success", "0", "0"], said


def test_an_upgrade_restarts_what_runs_and_a_removal_stops_it(
    machine: Machine, sern_package: Path, tmp_path: Path
) -> None:
    later = newer(sern_package, tmp_path)
    (machine.root / "root" / later.name).write_bytes(later.read_bytes())
    machine.run("systemctl", "stop", ROBOT)
    before = {unit: machine.show(unit, "MainPID") for unit in (RELAY, SITE)}
    kept = {path: path.read_bytes() for path in (machine.root / "etc/sern").rglob("*") if path.is_file()}
    machine.run("dpkg", "--install", f"/root/{later.name}")
    for unit, pid in before.items():
        assert machine.show(unit, "ActiveState") == "active" and machine.show(unit, "MainPID") != pid
    assert machine.show(ROBOT, "ActiveState") == "inactive", "what was stopped stays so"
    assert {path: path.read_bytes() for path in kept} == kept
    machine.run("systemctl", "start", ROBOT)
    together(machine)

    machine.run("dpkg", "--remove", "sern")
    assert machine.run("pgrep", "--uid", "sern", check=False).stdout == ""
    assert {path: path.read_bytes() for path in kept} == kept
