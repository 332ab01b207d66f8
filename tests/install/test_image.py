"""The container image: relay and client run in containers, say that they are healthy, and drain when stopped."""

import http.client
import os
import resource
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from sern_tools.ports import free_ports
from tests.install.machine import ROOT, run, wait_until
from tests.install.test_pythons import CLIENT, RELAY, ready

IMAGE: Final = "localhost/sern:latest"
BUILD_S: Final = 1800.0
USER: Final = 10001
"""Of the daemons in the image: who mounts keys gives them to it."""
LIMITS: Final = tuple(
    f"--ulimit={name}={min(resource.getrlimit(kind)[1], most)}"
    for name, kind, most in (("nofile", resource.RLIMIT_NOFILE, 16_384), ("nproc", resource.RLIMIT_NPROC, 4_096))
)
"""podman raises them by default, which root may not everywhere: in another container, for one."""
RUNTIMES: Final = ("crun", "runc")
"""crun does not start where the machine has the cgroups of both versions, as it says itself; runc does."""


@pytest.fixture(scope="module")
def podman(image: str) -> list[str]:
    """podman with a runtime that starts containers here; skips where none does, with what they said."""
    reasons = []
    for runtime in RUNTIMES:
        command = ["podman", "--runtime", runtime]
        done = run([*command, "run", "--rm", "--no-healthcheck", "--network=none", *LIMITS, image, "true"], check=False)
        if done.returncode == 0:
            return command
        reasons.append(f"{runtime}: {done.stderr.strip()}")
    pytest.skip(f"podman starts no container here: {'; '.join(reasons)}")


@pytest.fixture(scope="module")
def image(sern_package: Path) -> str:
    """Built from the package under test."""
    if os.geteuid() != 0:
        pytest.skip("needs root: sudo make test-install")
    if lacking := [name for name in ("buildah", "debootstrap", "podman") if shutil.which(name) is None]:
        pytest.skip(f"apt-get install {' '.join(lacking)}")
    run([ROOT / "deploy/image/build", sern_package], timeout_s=BUILD_S)
    return IMAGE


@pytest.fixture
def names(podman: list[str]) -> Iterator[list[str]]:
    """Names of containers that go with the test."""
    names = [f"sern-test-{os.getpid()}-{name}" for name in ("relay", "client")]
    yield names
    run([*podman, "rm", "--force", "--ignore", "--time", "0", *names])


def start(podman: list[str], image: str, name: str, config: Path, health_port: int) -> None:
    """As docs/install.md has it. `name` ends in that of the daemon."""
    daemon = name.rpartition("-")[2]
    run([*podman, "run", "--detach", "--name", name, "--network", "host", *LIMITS, "--volume", f"{config}:/etc/sern:ro",
         "--env", f"SERN_HEALTH=http://127.0.0.1:{health_port}/healthz", image, f"sern-{daemon}", "--config",
         f"/etc/sern/{daemon}.yaml"])  # fmt: skip


def said(podman: list[str], name: str) -> str:
    done = run([*podman, "logs", name], check=False)
    return done.stdout + done.stderr


def healthy(port: int) -> bool:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", "/healthz")
        return connection.getresponse().status == 200
    except ConnectionError:
        return False
    finally:
        connection.close()


def test_relay_and_client_run_in_containers(podman: list[str], image: str, names: list[str], tmp_path: Path) -> None:
    port, relay_http, client_http = free_ports(3)
    config = tmp_path / "sern"
    (config / "clients").mkdir(parents=True)
    for role, name in (("relay", "relay"), ("client", "jackal1")):
        run([*podman, "run", "--rm", "--no-healthcheck", "--network=none", *LIMITS, "--user", "0", "--volume",
             f"{config}:/out", image, "sern", "keygen", role, name, "--out", "/out"])  # fmt: skip
    shutil.copy(config / "jackal1.pub", config / "clients")
    (config / "relay.yaml").write_text(RELAY.format(port=port, http=relay_http))
    (config / "client.yaml").write_text(CLIENT.format(port=port, http=client_http))
    for path in [config, *config.rglob("*")]:
        os.chown(path, USER, USER)
    relay, client = names
    start(podman, image, relay, config, relay_http)
    start(podman, image, client, config, client_http)
    for name, health_port in ((relay, relay_http), (client, client_http)):
        wait_until(lambda health_port=health_port: healthy(health_port), lambda name=name: said(podman, name))  # type: ignore[misc]
    wait_until(
        lambda: ready(relay_http, "listening") and ready(client_http, ""),
        lambda: said(podman, relay) + said(podman, client),
    )
    for name in names:
        run([*podman, "healthcheck", "run", name])
        process = run([*podman, "inspect", "--format", "{{.State.Pid}}", name]).stdout.strip()
        status = Path(f"/proc/{process}/status").read_text()
        assert (
            f"Uid:\t{USER}\t" in status and "compiled core" in run([*podman, "exec", name, "sern", "--version"]).stdout
        )
    for name in (client, relay):
        run([*podman, "stop", "--time", "45", name])
        state = run([*podman, "inspect", "--format", "{{.State.Status}} {{.State.ExitCode}}", name]).stdout.strip()
        assert state == "exited 0", said(podman, name)
        assert "SIGTERM: stopping" in said(podman, name)
