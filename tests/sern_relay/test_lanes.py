"""The relay's datagram lanes: whose turn it is when several clients have something to hear."""

from types import SimpleNamespace
from typing import Any

import pytest

from sern_core.vocabulary.types import ClientName
from sern_relay import udp
from sern_relay.udp import RelayLanes


class FakeServer:
    """`UdpServer` whose sessions are their clients' names."""

    def __init__(self, *_: object, **_more: object) -> None: ...

    def open_session(self, client: ClientName, *_: object, **_more: object) -> Any:
        return SimpleNamespace(client=client, parameters=SimpleNamespace(to_envelope=dict), ready=None)

    def close(self) -> None: ...


class FakePump:
    """`Pump` that says for whom it was kicked."""

    kicked: list[ClientName]

    def __init__(self, port: Any, *_: object, **_more: object) -> None:
        self._client: ClientName = port.link.peer

    def kick(self) -> None:
        self.kicked.append(self._client)

    def close(self) -> None: ...


async def test_messages_leave_before_acknowledgements(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "UdpServer", FakeServer)
    monkeypatch.setattr(udp, "Pump", FakePump)
    monkeypatch.setattr(FakePump, "kicked", [], raising=False)
    quiet, hears_of_it, waits, more = (ClientName(name) for name in ("quiet", "hears_of_it", "waits", "more"))
    links = {
        name: SimpleNamespace(
            peer=name, dirty=name != quiet, sender=SimpleNamespace(pending=name in (waits, more)),
            close_lane=lambda **_: None,
        )
        for name in (quiet, hears_of_it, waits, more)
    }  # fmt: skip
    hub: Any = SimpleNamespace(links=links, offer_lane=lambda *_, **_more: None)
    lanes = RelayLanes(hub, ["tcp://192.0.2.9:1"], port_of=lambda _client: 1, after=lambda: None)
    for name in links:
        lanes.asked(name, ())
    FakePump.kicked.clear()
    lanes.flush()
    assert FakePump.kicked == [waits, more, hears_of_it]
    lanes.close()
