"""The datagram lane's keys run out on either side, or one side gives the lane up: there is another one soon."""

from pathlib import Path
from typing import Any

import pytest

from sern_client import udp as client_udp
from sern_client.daemon import ClientDaemon
from sern_core.path.lanes import LANE_UDP
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.message import TopicInfo, TopicSpec
from sern_core.vocabulary.types import ClientName, Encoding, PriorityClass, TopicName
from sern_relay.daemon import RelayDaemon
from sern_runtime import clock, seal
from tests.daemons import Lab
from tests.support import until

LIMIT = 400
SITE = ClientName("site")
BODY = b"x" * 800


class Traffic:
    """Messages one way, a few at each look, and how many datagrams sealed them there."""

    def __init__(self, relay: RelayDaemon, site: ClientDaemon, *, down: bool) -> None:
        self.relay = relay
        self.site = site
        self._down = down
        info = TopicInfo(TopicName("/feed/blob" if down else "/site/blob"), "std_msgs/msg/String", Encoding.CDR)
        spec = TopicSpec(PriorityClass.BULK, depth=100)
        now = clock.now()
        self._handle: Any = None
        self._channel: OutChannel | None = None
        if down:
            site.core.subscribe((".*",), now=now)
            self._handle = relay.hub.local.open(info, spec, ClientName("feed_x"), now=now)
        else:
            self._channel = site.core.publish(info, spec, now=now)
            relay.hub.streams.tap = lambda _stream: True
            relay.hub.streams.refresh_interest(now=now)

    def send(self) -> None:
        now = clock.now()
        for _ in range(10):
            if self._channel is not None:
                self.site.core.send(self._channel, BODY, 0, now=now)
            else:
                self.relay.hub.local.inject(self._handle, BODY, 0, now=now)
        self.relay.transports.after()
        self.site.connection.wake()

    def sessions(self) -> set[int]:
        """The datagram sessions that carry data now, by their number."""
        lanes = self.relay.transports.lanes
        on_it = self.site.core.link.lane.id == LANE_UDP and self.relay.hub.links[SITE].lane.id == LANE_UDP
        return {lanes._lanes[SITE][0].id} if lanes is not None and on_it and SITE in lanes._lanes else set()


@pytest.mark.parametrize("down", [True, False], ids=["relay", "client"])
async def test_a_lane_whose_keys_run_out_is_there_again(
    tmp_path: Path, down: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for cipher in seal.SEAL_LIMITS:
        monkeypatch.setitem(seal.SEAL_LIMITS, cipher, LIMIT)
    async with Lab(tmp_path, "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.client_file("site", {"kind": "synthetic", "role": "operator"}))
        traffic = Traffic(relay, site, down=down)
        seen: set[int] = set()

        def another() -> bool:
            traffic.send()
            seen.update(traffic.sessions())
            return len(seen) >= 3

        await until(another, "three sets of keys were used up", deadline_s=60.0)
        assert len(site.core.link.sender.channels) >= 1 and site.core.link.established
        assert not [record for record in caplog.records if record.levelname == "ERROR"]
        await lab.end(site)
        await lab.end(relay)


async def test_a_lane_that_the_relay_gave_up_is_asked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is silent while the stream works. The pause doubles while that helps nothing."""
    monkeypatch.setattr(client_udp, "ASK_AGAIN_S", (0.2, 0.8))
    async with Lab(tmp_path, "site") as lab:
        relay = await lab.relay()
        site = await lab.connected(lab.client_file("site", {"kind": "synthetic", "role": "operator"}))
        traffic = Traffic(relay, site, down=True)
        assert relay.transports.lanes is not None and site.connection.lane is not None
        for _ in range(2):
            await until(traffic.sessions)
            session = relay.transports.lanes._lanes[SITE][0]
            relay.transports.lanes._gone(SITE, session)
            await until(lambda old=session.id: traffic.sessions() - {old})  # type: ignore[misc]
        lane = site.connection.lane
        # `ask_s` is None also while an answer is awaited; only a lane that works makes the pause short again.
        await until(lambda: lane.ask_s is None and lane.pause_s == 0.2, "it works, so nothing is asked for")
        await lab.end(site)
        await lab.end(relay)
