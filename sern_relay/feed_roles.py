"""The feed of a relay as roles in its file come and go: the first brings it, and it goes soon after the last one."""

import logging
from collections.abc import Callable
from pathlib import Path

import zmq

from sern_core.relay.hub import Hub
from sern_core.topics.rules import FeedRole
from sern_core.vocabulary.errors import ConfigError
from sern_relay.feed import OnRefused, RelayFeed
from sern_relay.readers import Readers
from sern_runtime.reload_state import ReloadState

_log = logging.getLogger(__name__)


class FeedRoles:
    """`start` once, `use` with each reload, `look` about once a second. The feed is `readers.feed`, which closes it.

    `path` is the relay's file, which lines of the log name. What of the roles is not in force goes into `reloads`, and
    `in_force` is called when it is after all. `after` and `refused` are for the feed.
    """

    def __init__(
        self,
        path: Path,
        hub: Hub,
        readers: Readers,
        reloads: ReloadState,
        *,
        in_force: Callable[[float], None],
        after: Callable[[], None],
        refused: OnRefused,
    ) -> None:
        self._path = path
        self._hub = hub
        self._readers = readers
        self._reloads = reloads
        self._in_force = in_force
        self._after = after
        self._refused = refused
        self._ctx: zmq.Context[zmq.Socket[bytes]] | None = None

    def start(self, ctx: "zmq.Context[zmq.Socket[bytes]]", roles: tuple[FeedRole, ...]) -> None:
        """Open the feed, if there are roles. Raises ConfigError where an endpoint cannot be had."""
        self._ctx = ctx
        if roles:
            self._readers.feed = self._make(ctx, roles)

    def use(self, roles: tuple[FeedRole, ...], *, now: float) -> None:
        """Make these the feed's roles."""
        if self._readers.feed is None:
            if not roles or self._ctx is None:
                return
            self._readers.feed = self._make(self._ctx, ())  # then as any other: what can be had is in force
        try:
            self._readers.feed.update(roles, now=now)
        except ConfigError as error:
            self._reloads.failed_in_part("feed.roles", str(error), now=now)
            _log.error("%s: feed.roles: not all of them are in force: %s", self._path, error)

    def look(self, *, now: float) -> None:
        """Let the feed do what it does by time, try again for what could not be had, and close a feed without roles."""
        feed = self._readers.feed
        if feed is None:
            return
        feed.sweep(now=now)
        # What was in use at a reload may be free by now; that it was not has been said and counted.
        if feed.feed.missing and feed.open_missing():
            self._reloads.part_in_force()
            self._in_force(now)
        if feed.over:
            self._readers.feed = None
            feed.close()

    def _make(self, ctx: "zmq.Context[zmq.Socket[bytes]]", roles: tuple[FeedRole, ...]) -> RelayFeed:
        return RelayFeed(ctx, self._hub, roles, after=self._after, refused=self._refused)
