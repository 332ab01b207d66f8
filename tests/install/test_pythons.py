"""The wheel without a compiled core, installed by pip with the pinned dependencies, on each Python that SERN names."""

import http.client
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from sern_tools.ports import free_ports
from tests.install.conftest import VARIABLE
from tests.install.machine import ROOT, run, wait_until
from tests.support import child

PYTHONS: Final = ("3.11", "3.12", "3.13")
INSTALL_S: Final = 1800.0
RELAY: Final = """
relay: {{name: relay, listen: ["tcp://127.0.0.1:{port}"], secret_key_file: relay.key, clients_dir: clients}}
access: [{{client: jackal1, publish: ['/{{self}}/.*']}}]
http: {{listen: "127.0.0.1:{http}"}}
"""
CLIENT: Final = """
client: {{name: jackal1}}
relay: {{endpoint: "tcp://127.0.0.1:{port}", server_key_file: relay.pub, secret_key_file: jackal1.key}}
endpoint: {{kind: synthetic, role: robot, seed: 1, encoding: ros1}}
http: {{listen: "127.0.0.1:{http}"}}
"""


def interpreter(version: str) -> str:
    """A Python of this version: on the path, or of pyenv. Skips where there is none."""
    places = [shutil.which(f"python{version}"), *sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))]
    for place in [place for place in places if place is not None]:
        says = subprocess.run([place, "--version"], capture_output=True, text=True, check=False)  # pyenv has shims
        if says.stdout.startswith(f"Python {version}."):
            return str(place)
    pytest.skip(f"there is no Python {version}: pyenv install {version}, or apt-get install python{version}")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pure wheel of this checkout, built once."""
    if not os.environ.get(VARIABLE):
        pytest.skip("make test-install runs this: it installs three environments")
    source = tmp_path_factory.mktemp("source")
    for package in ROOT.glob("sern_*"):
        shutil.copytree(package, source / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    run([sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps",
         "--no-build-isolation", "--wheel-dir", source / "dist", source])  # fmt: skip
    (built,) = (source / "dist").glob("sern-*-py3-none-any.whl")
    return built


def ready(port: int, reason: str) -> bool:
    """Whether a daemon's /readyz is well and says this."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", "/readyz")
        answer = connection.getresponse()
        return answer.status == 200 and reason in answer.read().decode()
    except ConnectionError:
        return False
    finally:
        connection.close()


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("version", PYTHONS)
def test_it_installs_and_runs(version: str, wheel: Path, tmp_path: Path) -> None:
    python = interpreter(version)
    venv = tmp_path / "venv"
    run([python, "-m", "venv", venv])
    run([venv / "bin/python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--constraint",
         ROOT / "constraints.txt", wheel], timeout_s=INSTALL_S)  # fmt: skip
    run([venv / "bin/python", "-m", "pip", "check"])
    assert "plain Python core" in run([venv / "bin/sern", "--version"]).stdout
    run([venv / "bin/sern", "keygen", "relay", "relay", "--out", tmp_path])
    run([venv / "bin/sern", "keygen", "client", "jackal1", "--out", tmp_path])
    (tmp_path / "clients").mkdir()
    shutil.copy(tmp_path / "jackal1.pub", tmp_path / "clients")
    port, relay_http, client_http = free_ports(3)
    (tmp_path / "relay.yaml").write_text(RELAY.format(port=port, http=relay_http))
    (tmp_path / "client.yaml").write_text(CLIENT.format(port=port, http=client_http))
    daemons = [[venv / "bin" / name, "--config", tmp_path / file]
               for name, file in (("sern-relay", "relay.yaml"), ("sern-client", "client.yaml"))]  # fmt: skip
    with (
        (tmp_path / "said").open("w") as said,
        child([*map(str, daemons[0])], stderr=said) as relay,
        child([*map(str, daemons[1])], stderr=said) as client,
    ):
        wait_until(lambda: ready(relay_http, "listening"), (tmp_path / "said").read_text)
        wait_until(lambda: ready(client_http, ""), (tmp_path / "said").read_text)
        for process in (client, relay):
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0, (tmp_path / "said").read_text()
    shutil.rmtree(venv)
