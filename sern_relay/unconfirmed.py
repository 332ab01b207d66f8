"""What connected clients have yet to confirm when a relay stops."""

import asyncio
from collections.abc import Mapping
from typing import Final

from sern_core.link.link import Link
from sern_core.stream.out_channel import OutChannel
from sern_core.vocabulary.types import ClientName
from sern_runtime import clock
from sern_runtime.draining import Progress

PATIENCE_S: Final = 5.0
"""How long a stopping relay waits for the next sign that what it holds for connected clients gets further."""


async def wait_confirmed(links: Mapping[ClientName, Link], *, limit_s: float) -> None:
    """Wait until connected clients have confirmed what is retained for them now: while that gets anywhere, and at most
    `limit_s`. What comes in from now on its sources keep until the next relay confirms it."""
    now = clock.now()
    progress = Progress()
    give_up_s = now + limit_s
    unconfirmed = [
        (link, channel, channel.next_seq - 1)
        for link in links.values()
        for channel in link.sender.channels.values()
        if channel.retained
    ]
    while now < give_up_s:
        unconfirmed = [item for item in unconfirmed if _unconfirmed(*item)]
        if not unconfirmed:
            break
        left = (
            sum(len(channel.retained) for _link, channel, _last in unconfirmed),
            sum(nbytes for link in links.values() for _messages, nbytes in link.sender.queued().values()),
        )
        if progress.still_s(left, now=now) > PATIENCE_S:
            break
        await asyncio.sleep(0.02)
        now = clock.now()


def _unconfirmed(link: Link, channel: OutChannel, last: int) -> bool:
    """Whether a connected client has yet to confirm messages up to `last`."""
    return link.established and bool(channel.retained) and channel.retained[0].seq <= last
