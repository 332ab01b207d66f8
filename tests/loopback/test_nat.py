"""A client behind a NAT that forgets its mappings: the datagram lane goes on from another port or address, and the
reliable streams in both directions stay complete."""

from functools import partial
from pathlib import Path
from typing import Final

import pytest

from sern_client.daemon import ClientDaemon
from sern_tools.ports import free_ports
from tests.between import INSIDE, Nat, Outer
from tests.daemons import HOST, Lab, bodies, under, write_bag
from tests.support import until

COUNT: Final = 1000
NAMES: Final = ("robot1", "site1")


@pytest.mark.parametrize("hangs", [False, True], ids=["datagrams", "everything"])
@pytest.mark.parametrize("behind", ["robot1", "site1"])
async def test_a_forgotten_mapping_loses_nothing_reliable(
    tmp_path: Path, behind: str, hangs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sender is behind the NAT, or the receiver. `everything`: the NAT has forgotten the TCP connection as well, as
    one does that was restarted."""
    monkeypatch.setattr(
        "sern_core.path.flight.STALL_MIN_S", 30.0
    )  # a busy machine's pause is no lane without datagrams
    (port,) = free_ports(1)
    bag = write_bag(tmp_path / "run.bag", {"/log": COUNT})
    nat = Nat(port)
    async with Lab(tmp_path, "robot1", "site1", relay_port=port) as lab:
        try:
            await lab.relay()
            await nat.start()
            relay = {name: {"endpoint": f"tcp://{INSIDE if name == behind else HOST}:{port}"} for name in NAMES}
            site = await lab.connected(lab.recorder_file("site1", "/robot1/.*", relay=relay["site1"]))
            play = {"rate": 0.25}
            robot = await lab.connected(lab.player_file("robot1", bag, play=play, relay=relay["robot1"]))
            link = (robot if behind == "robot1" else site).core.link
            await until(lambda: link.lane.name == "udp", "datagrams are used")
            under_way = 0
            for address in ("127.0.0.3", "127.0.0.4", "127.0.0.3", "127.0.0.5"):
                before = delivered(site)
                under_way += before < COUNT
                if hangs:
                    await nat.cut()
                mapping = await nat.rebind(address)
                await until(partial(_answered, mapping), f"the relay answers to {address}")
                await until(partial(_more, site, before), "the site hears more")
                assert link.lane.name == "udp", "it has fallen back"
            assert under_way, "everything was there before the first change"
            await until(lambda: delivered(site) == COUNT, "everything has arrived")
        finally:
            await nat.close()
    assert bodies(tmp_path / "site1.bag") == under("robot1", bodies(bag))


def delivered(site: ClientDaemon) -> int:
    return int(site.topics().get("/robot1/log", {}).get("delivered", 0))


def _answered(mapping: Outer) -> bool:
    return mapping.replies > 0


def _more(site: ClientDaemon, before: int) -> bool:
    return delivered(site) > before or before == COUNT
