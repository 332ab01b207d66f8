"""A key that no longer holds opens no session: over ipc:// as over TCP, and also where a connection lives on."""

from pathlib import Path

import pytest
import zmq

from sern_core.vocabulary.types import ClientName
from sern_runtime.config.keys import PublicKey, PublicKeys, generate, load_public, load_secret, write_public
from sern_runtime.monitor import ConnectionTable
from tests.daemons import Lab
from tests.loopback.test_security import DEAD_ENDS
from tests.strangers import Stranger, hello
from tests.support import until


def local(lab: Lab) -> None:
    """Relay and clients meet at a path of this machine."""
    lab.endpoint = f"ipc://{lab.directory}/relay.ipc"


def changed(lab: Lab, change: str) -> None:
    """The key of robot2 is removed, replaced, given to another, ended or put off."""
    file = lab.clients_dir / "robot2.pub"
    (known,) = load_public(file).keys
    if change == "removed":
        file.unlink()
    elif change == "replaced":
        lab.make_keys("robot2")
    elif change == "given to another":
        file.unlink()
        write_public(lab.clients_dir / "robot3.pub", PublicKeys(ClientName("robot3"), (known,)))
    else:
        window = PublicKey(known.key, not_after_s=1e9) if change == "ended" else PublicKey(known.key, not_before_s=4e9)
        write_public(file, PublicKeys(ClientName("robot2"), (window,)), replace=True)


async def test_a_replaced_key_is_cut_off_over_ipc_and_comes_back_when_it_is_put_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Lab(tmp_path, "robot1") as lab:
        local(lab)
        relay = await lab.relay()
        assert relay.transports.server is not None and relay.zap is not None
        robot = await lab.connected(lab.client_file("robot1", DEAD_ENDS))
        public = lab.clients_dir / "robot1.pub"
        old = public.read_text()
        another = PublicKey(generate(ClientName("robot1")).public_key)
        write_public(public, PublicKeys(ClientName("robot1"), (another,)), replace=True)
        relay.reload()
        assert list(relay.transports.server.clients.sessions()) == []
        await until(lambda: "refused our key" in robot.news.reason)
        refused = relay.zap.counters.unknown_key
        await until(lambda: relay.zap is not None and relay.zap.counters.unknown_key > refused, "it tries again")
        assert list(relay.transports.server.clients.sessions()) == [] and not robot.core.link.established
        assert caplog.text.count("robot1 lost a key; 1 connections cut") == 1
        public.write_text(old)
        relay.reload()
        await until(lambda: robot.core.link.established, "it is back by itself")
        await lab.end(robot)
        await lab.end(relay)


@pytest.mark.parametrize("ipc", [True, False], ids=["ipc", "tcp"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("removed", "is revoked"), ("replaced", "is revoked"), ("given to another", "is revoked"),
        ("ended", "has expired"), ("put off", "is not valid yet"),
    ],
)  # fmt: skip
async def test_a_connection_that_outlives_its_key_is_not_heard(
    tmp_path: Path, ipc: bool, change: str, said: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing can end it here: what it says is refused by its key, and said once."""
    async with Lab(tmp_path, "robot2") as lab:
        if ipc:
            local(lab)
        relay = await lab.relay()
        assert relay.transports.server is not None
        server = relay.transports.server
        async with Stranger(lab, load_secret(tmp_path / "robot2.key")) as silent:
            await until(lambda: zmq.Event.HANDSHAKE_SUCCEEDED in silent.events, "admitted by its key, that holds")
            with monkeypatch.context() as patch:
                patch.setattr(ConnectionTable, "cut_user", lambda _table, _user: 0)
                changed(lab, change)
                relay.reload()
            assert zmq.Event.DISCONNECTED not in silent.events
            messages = server.socket.messages
            for _ in range(20):
                await silent.send(hello("robot2"))
            await silent.cut()
            assert server.socket.messages > messages
            assert list(server.clients.sessions()) == [] and silent.received == []
            assert server.revoked == 1
            assert caplog.text.count(f"the key of robot2 {said}") == 1
        await lab.end(relay)
