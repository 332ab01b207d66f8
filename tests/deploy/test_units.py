"""The systemd units: systemd reads them, they hold what the daemons need, and libzmq is not locked out."""

import re
import shlex
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.support import child

UNITS: Final = Path(__file__).resolve().parents[2] / "deploy" / "systemd"
NAMES: Final = ("sern-relay.service", "sern-client.service", "sern-client@.service", "sern-twin.service",
                "sern-navigation.service")  # fmt: skip
NOT_NAVIGATION: Final = ("ExecReload", "RuntimeDirectory", "RuntimeDirectoryMode")  # no keys, and no local socket
ONCE: Final = {
    ("Unit", "StartLimitIntervalSec"): "0",
    ("Service", "Type"): "notify",
    ("Service", "NotifyAccess"): "main",
    ("Service", "Restart"): "always",
    ("Service", "RestartSec"): "2",
    ("Service", "WatchdogSec"): "15",
    ("Service", "KillSignal"): "SIGTERM",
    ("Service", "TimeoutStopSec"): "45",
    ("Service", "User"): "sern",
    ("Service", "UMask"): "0077",
    ("Service", "NoNewPrivileges"): "yes",
    ("Service", "ProtectSystem"): "strict",
    ("Install", "WantedBy"): "multi-user.target",
}
KNOWN: Final = {
    "Unit": {"Description", "After", "StartLimitIntervalSec"},
    "Service": {
        "Type NotifyAccess ExecStart ExecReload User Group UMask WorkingDirectory StateDirectory StateDirectoryMode",
        "RuntimeDirectory RuntimeDirectoryMode",
        "Restart RestartSec WatchdogSec KillSignal TimeoutStopSec LimitNOFILE LimitCORE NoNewPrivileges",
        "CapabilityBoundingSet ProtectSystem ProtectHome PrivateTmp PrivateDevices ProtectKernelTunables",
        "ProtectKernelModules ProtectKernelLogs ProtectControlGroups ProtectClock ProtectHostname LockPersonality",
        "RestrictSUIDSGID RestrictNamespaces RestrictRealtime PrivateUsers PrivateMounts ProtectProc",
        "RestrictAddressFamilies SystemCallArchitectures SystemCallFilter SystemCallErrorNumber",
    },
    "Install": {"WantedBy"},
}


def read(name: str) -> list[tuple[str, str, str]]:
    """(section, key, value) of every line of a unit."""
    found, section = [], ""
    for line in (UNITS / name).read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        if match := re.fullmatch(r"\[(\w+)\]", line):
            section = match[1]
            continue
        key, equals, value = line.partition("=")
        assert equals, f"{name}: {line}"
        found.append((section, key, value))
    return found


def values(name: str, key: str) -> list[str]:
    return [value for _, known, value in read(name) if known == key]


@pytest.mark.parametrize("name", NAMES)
def test_every_key_is_known_and_stands_once(name: str) -> None:
    lines = read(name)
    known = {(section, key) for section, groups in KNOWN.items() for group in groups for key in group.split()}
    keys = [(section, key) for section, key, _ in lines if key != "SystemCallFilter"]  # a list, a line each
    assert set(keys) < known
    assert len(keys) == len(set(keys))
    assert ONCE.items() <= {(section, key): value for section, key, value in lines}.items()


@pytest.mark.parametrize("name", NAMES)
def test_libzmq_is_not_locked_out(name: str) -> None:
    families = values(name, "RestrictAddressFamilies")[0].split()
    assert {"AF_INET", "AF_INET6", "AF_UNIX", "AF_NETLINK"} <= set(families)
    # The last line that names a call decides. What is not allowed fails, and does not end the daemon.
    assert values(name, "SystemCallFilter") == ["@system-service", "~@privileged @resources", "sched_setscheduler"]
    assert values(name, "SystemCallErrorNumber") == ["EPERM"]
    assert not values(name, "MemoryDenyWriteExecute")
    # It would take the shared memory of DDS from the other processes of the same user, and from a robot's nodes.
    assert not values(name, "RemoveIPC")


@pytest.mark.parametrize("name", NAMES)
def test_the_exposure_that_systemd_counts_is_low(name: str, tmp_path: Path) -> None:
    """1.5 of 10 at the most. What is left is what a bridge does: it speaks over the network, with libzmq."""
    assert rated(name, (UNITS / name).read_text(), tmp_path).returncode == 0
    # The threshold tells apart: without one of the lines it is over it.
    looser = (UNITS / name).read_text().replace("CapabilityBoundingSet=\n", "")
    assert rated(name, looser, tmp_path).returncode != 0


def rated(name: str, text: str, directory: Path) -> "subprocess.CompletedProcess[str]":
    """What `systemd-analyze security` says of a unit; it fails above 1.5."""
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed: apt-get install systemd")
    unit = directory / name
    unit.write_text(text)
    command = [program, "security", "--offline=true", "--threshold=15", "--no-pager", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd-analyze rates no files: systemd 250 and later does")
    assert "Overall exposure level" in done.stdout, done.stderr
    return done


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("unit", ["sern-relay", "sern-client", "sern-client@", "sern-twin"])
def test_reload_needs_no_program_but_the_shell(unit: str) -> None:
    command = shlex.split(values(f"{unit}.service", "ExecReload")[0])
    assert command[:2] == ["/bin/sh", "-c"]
    with child(["/bin/cat"], stdin=subprocess.PIPE) as daemon:
        # As systemd runs it, with nothing to be found on the path.
        environment = {"MAINPID": str(daemon.pid), "PATH": "/nowhere"}
        assert subprocess.run(command, env=environment, timeout=60, check=False).returncode == 0
        assert daemon.wait(timeout=60) == -signal.SIGHUP


def test_the_template_is_the_client_with_its_name_in_it() -> None:
    expected = {
        "Description": "SERN client %i",
        "ExecStart": "/opt/sern/bin/sern-client --config /etc/sern/%i.yaml",
        "WorkingDirectory": "/var/lib/sern/%i",
        "StateDirectory": "sern sern/%i",
        "RuntimeDirectory": "sern-client-%i",
    }
    single = read("sern-client.service")
    assert read("sern-client@.service") == [(s, key, expected.get(key, value)) for s, key, value in single]


def test_that_of_the_twins_is_the_client_with_another_program() -> None:
    expected = {"Description": "SERN twins", "ExecStart": "/opt/sern/bin/sern-twin --config /etc/sern/twin.yaml"}
    expected["RuntimeDirectory"] = "sern-twin"
    client = read("sern-client.service")
    assert read("sern-twin.service") == [(s, key, expected.get(key, value)) for s, key, value in client]


def test_that_of_the_navigation_is_the_client_with_another_program() -> None:
    expected = {
        "Description": "SERN navigation",
        "ExecStart": "/opt/sern/bin/sern-navigation --config /etc/sern/navigation.yaml",
    }
    client = [entry for entry in read("sern-client.service") if entry[1] not in NOT_NAVIGATION]
    assert read("sern-navigation.service") == [(s, key, expected.get(key, value)) for s, key, value in client]


@pytest.mark.parametrize("name", NAMES)
def test_systemd_accepts_them(name: str, tmp_path: Path) -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("systemd-analyze is not installed: apt-get install systemd")
    unit = tmp_path / name.replace("@", "@robot1")
    # It looks whether the program is there: /opt/sern is only on hosts where SERN is installed.
    unit.write_text(re.sub(r"/opt/sern/bin/\S+", "/bin/true", (UNITS / name).read_text()))
    result = subprocess.run(
        [program, "verify", "--recursive-errors=no", "--man=no", str(unit)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    if "Failed to initialize manager" in result.stderr:
        pytest.skip(f"systemd-analyze does not work here: {result.stderr.splitlines()[0]}")
    assert (result.returncode, result.stderr) == (0, "")
