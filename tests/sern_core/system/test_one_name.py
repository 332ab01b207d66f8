"""Two processes with one name: each takes the session from the other, more and more seldom."""

import re
from typing import Any, Final

from sern_core.relay.hub import Hub
from sern_core.relay.hub_port import HubPort
from sern_core.site.client import ClientCore
from sern_core.vocabulary.params import LinkParams, SchedulerParams
from sern_core.vocabulary.types import ClientName
from tests.world import OPEN_ACCESS

STEP_S: Final = 0.05


class Told:
    """`ClientEvents` and `HubEvents`: counts what it is told."""

    def __init__(self) -> None:
        self.calls: dict[str, int] = {}
        self.last: dict[str, tuple[Any, ...]] = {}

    def __getattr__(self, name: str) -> Any:
        def told(*args: Any, **kwargs: Any) -> None:
            self.last[name] = (*args, *kwargs.values())
            self.calls[name] = self.calls.get(name, 0) + 1

        return told


def test_of_two_with_one_name_neither_flaps_for_ever() -> None:
    hub_told = Told()
    hub = Hub(
        name=ClientName("relay"), boot=1, access=OPEN_ACCESS, known=lambda _name: True, events=hub_told,
        link=LinkParams(), scheduler=SchedulerParams(), wall_ns=lambda now: int(now * 1e9), now=0.0,
    )  # fmt: skip
    events = [Told(), Told()]
    cores = [
        ClientCore(
            name=ClientName("site"), boot=boot, events=events[boot], link=LinkParams(), scheduler=SchedulerParams(),
            now=0.0,
        )
        for boot in range(2)
    ]  # fmt: skip
    ports = [HubPort(hub, core.name, f"10.0.0.{boot}:4000") for boot, core in enumerate(cores)]
    for core in cores:
        core.link.connected(now=0.0)

    def run(from_s: float, to_s: float) -> None:
        for step in range(round(from_s / STEP_S), round(to_s / STEP_S)):
            now = step * STEP_S
            for core, port in zip(cores, ports, strict=False):
                for here, there in ((core.link, port), (port, core.link)):
                    here.handle_timeout(now=now)
                    for _ in range(5):
                        data = here.next_datagram(now=now)
                        if data is not None:
                            there.receive(data, now=now)
            if step % 5 == 0:
                for core in cores:
                    core.subscribe(("/a", f"/{step}"), now=now)  # something to say, as every client has

    run(0.0, 2.0)
    text = "another process connected as site from 10.0.0.{}:4000; one name has one connection: end one of the two, "
    for boot, told in enumerate(events):
        code, why = told.last["rejected"]
        assert code == "displaced" and why.startswith(text.format(1 - boot))
        assert told.last["link_down"] == (why,)
    assert [core.link.handshake.displaced for core in cores] == [not core.link.established for core in cores]
    assert hub_told.last["refused"][:2] == ("site", "displaced")
    assert set(re.findall(r"10\.0\.0\.\d", hub_told.last["refused"][2])) == {"10.0.0.0", "10.0.0.1"}
    run(2.0, 40.0)
    first = sum(told.calls["link_up"] for told in events)
    run(40.0, 100.0)
    later = sum(told.calls["link_up"] for told in events) - first
    assert later <= 60 / 10 * 2 + 2, "two sessions for each time that the one that waits tries again"
    # The other ends: the one that is left has its session, and keeps it.
    link = cores[1].link
    ports[1].disconnected(now=100.0)
    link.disconnected(now=100.0)
    cores.pop()
    run(100.0, 115.0)
    assert cores[0].link.established and hub.links[ClientName("site")].end.peer_boot == 0
    assert not cores[0].link.handshake.displaced
    ups = events[0].calls["link_up"]
    run(115.0, 130.0)
    assert events[0].calls["link_up"] == ups
