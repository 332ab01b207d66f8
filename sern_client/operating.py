"""What an operator changes while a client runs: a reload of its file (SIGHUP), and requests on its local socket.

Requests, a JSON object each (`sern_runtime/local_socket.py`):

    {"do": "list"}                                                        what is set by hand
    {"do": "set", "topic": "/scan", "words": ["max_rate_hz=2"]}
    {"do": "reset", "topic": "/scan"}
    {"do": "profile", "name": "mapping"}                                  null: the file's
    {"do": "release", "topic": "/robot1/e_stop"}
    {"do": "take", "topic": "/robot1/cmd_vel", "how": "ask"}              or force, give; null: who holds it
"""

import logging
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, Final

from sern_client.bridge import Bridge
from sern_client.e_stop import RELEASE_SUFFIX, EStops
from sern_client.holding import WORDS
from sern_client.settings import Settings
from sern_core.vocabulary.errors import ConfigError, UsageError
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.names import name_problem
from sern_core.vocabulary.types import TopicName
from sern_runtime import clock
from sern_runtime.adaptation import Adaptation
from sern_runtime.config.client import ClientFile, load_client
from sern_runtime.config.load import Loaded
from sern_runtime.entry import log_warnings
from sern_runtime.events import EventLog
from sern_runtime.local_socket import SUFFIX, Json, LocalServer, socket_directory
from sern_runtime.reload_state import ReloadState
from sern_runtime.sdnotify import Notifier

MAX_WORDS: Final = 32
"""Keys of a topic that are set at once."""

_log = logging.getLogger(__name__)


class Operating:
    """`start`, then any calls, then `stop`. `status` is one line for systemd; `reload_keys` is called with each
    reload."""

    def __init__(
        self,
        loaded: Loaded[ClientFile],
        bridge: Bridge,
        adaptation: Adaptation | None,
        events: EventLog,
        notifier: Notifier,
        *,
        e_stops: EStops,
        status: Callable[[], str],
        reload_keys: Callable[[], None],
    ) -> None:
        self.reloads = ReloadState()
        self.settings = Settings(loaded.model, self._use, lambda: bridge.outbound.known)
        self._loaded = loaded
        self._bridge = bridge
        self._adaptation = adaptation
        self._events = events
        self._notifier = notifier
        self._status = status
        self.e_stops = e_stops
        self._reload_keys = reload_keys
        self._commands: dict[str, Callable[[Json], Awaitable[Json]]] = {
            "list": self._list,
            "set": self._set,
            "reset": self._reset,
            "profile": self._profile,
            "release": self._release,
            "take": self._take,
        }
        self._server: LocalServer | None = None

    async def start(self) -> None:
        """Listen on the local socket. A robot is driven without one as well: that there is none is said, no more."""
        section = self._loaded.model.local
        if not section.listen:
            return
        path = socket_directory() / f"{self._loaded.model.name}{SUFFIX}"
        if section.socket is not None:
            path = self._loaded.resolve(section.socket)
        server = LocalServer(path, self.answer)
        try:
            await server.start()
        except ConfigError as error:
            _log.warning("sern set, take and release cannot reach this client: %s", error)
            return
        self._server = server
        _log.info("the local socket is %s", path)

    async def stop(self) -> None:
        if self._server is not None:
            await self._server.stop()

    @property
    def refused(self) -> int:
        """Connections and requests on the local socket that were refused."""
        return 0 if self._server is None else self._server.refused

    @property
    def socket(self) -> Path | None:
        """The socket on which it listens; None: there is none."""
        return None if self._server is None else self._server.path

    # --- the file anew ----------------------------------------------------------------------------------------------

    def reload(self) -> None:
        """SIGHUP: read the file and the keys anew. A file that is wrong changes nothing."""
        self._notifier.reloading()
        now = clock.now()
        try:
            loaded = load_client(self._loaded.path)
            done = self.settings.reload(loaded.model)
        except (ConfigError, UsageError) as error:
            self.reloads.failed(str(error), now=now)
            words = "reload failed, the old configuration stays: %s"
            self._events.say(_log, logging.ERROR, "reload_failed", "", words, error)
        else:
            self.reloads.read()
            log_warnings(_log, loaded.warnings)
            failed_s = self.reloads.take_recovery_s(now=now)
            if failed_s is not None:
                _log.error("the reload works again: what the file says is in force, after %.0f s", failed_s)
            rest = f"; {', '.join(done.restart)} changed and need a restart" if done.restart else ""
            rest += f"; no more set by hand, as the file says otherwise: {', '.join(done.ended)}" if done.ended else ""
            words = "reloaded topics, subscriptions, discovery and adaptation%s"
            self._events.say(_log, logging.INFO, "reloaded", "", words, rest)
        finally:
            self._reload_keys()
            self._notifier.ready(self._status())

    def _use(self, file: ClientFile) -> None:
        """Have a file in force. What may be refused comes first."""
        rules, discovery, patterns = file.rules(), file.discovery.filter(), file.subscribe_patterns()
        if self._adaptation is not None and file.adaptation is not None:
            self._adaptation.use(file.adaptation, rules.rules)
        self._bridge.use(rules, discovery)
        self._bridge.inbound.subscribed.begin(patterns)

    # --- requests ---------------------------------------------------------------------------------------------------

    async def answer(self, request: Json) -> Json:
        """The answer to one request. Raises UsageError for one that cannot be."""
        command = self._commands.get(str(request.get("do")))
        if command is None:
            raise UsageError(
                f"{str(request.get('do'))[:40]!r} is nothing that this client does; is it of this release?"
            )
        return await command(request)

    async def _list(self, _request: Json) -> Json:
        return self.to_json()

    def to_json(self) -> dict[str, Any]:
        """What is set by hand, and which topics wait to be offered otherwise."""
        return {
            **self.settings.to_json(),
            "changing": list(self._bridge.outbound.changing),
            "e_stops": dict(self.e_stops.latched),
        }

    async def _set(self, request: Json) -> Json:
        words = request.get("words")
        if not isinstance(words, list) or not 0 < len(words) <= MAX_WORDS:
            raise UsageError(f"say what to set: 1 to {MAX_WORDS} of key=value")
        name = self._local(request)
        keys = self.settings.set(name, [str(word) for word in words])
        said = " ".join(f"{key}={value}" for key, value in keys.items())
        self._events.say(_log, logging.WARNING, "set", name, "%s: set by hand: %s", name, said)
        return {"topic": name, "set": keys, "changing": name in self._bridge.outbound.changing}

    async def _reset(self, request: Json) -> Json:
        name = self._local(request)
        self.settings.reset(name)
        self._events.say(_log, logging.WARNING, "set", name, "%s: as the file says again", name)
        return {"topic": name, "changing": name in self._bridge.outbound.changing}

    async def _profile(self, request: Json) -> Json:
        profile = request.get("name")
        self.settings.set_profile(None if profile is None else str(profile))
        words = "the profile of the adaptation is the file's again" if profile is None else "profile set by hand: %s"
        self._events.say(_log, logging.WARNING, "set", "", words, *(() if profile is None else (profile,)))
        return {"profile": profile}

    async def _release(self, request: Json) -> Json:
        """Release an e-stop: our own, or, by its global name, that of another site."""
        name = TopicName(str(request.get("topic", "")))
        problem = name_problem(name)
        if problem is not None:
            raise UsageError(f"topic {name[:80]!r} {problem}")
        site = self._bridge.site
        local = name if name in self.e_stops.topics else site.rules.inward(name, namespace=site.namespace)
        if local in self.e_stops.topics:
            self.e_stops.release(local, who="an operator here")
            return {"topic": local, "at": ""}
        await self._bridge.asking.ask(TopicName(f"{name}{RELEASE_SUFFIX}"), "release")
        return {"topic": name, "at": "its site"}

    async def _take(self, request: Json) -> Json:
        """Who holds a command topic, or that another one shall."""
        name, how = TopicName(str(request.get("topic", ""))), request.get("how")
        holding = self._bridge.holding
        if how is None:
            return {"held": holding.to_json()}
        if how not in WORDS:
            raise UsageError(f"{str(how)[:40]!r} is none of {', '.join(WORDS)}")
        return {"topic": name, **await holding.take(name, str(how))}

    def _local(self, request: Json) -> TopicName:
        """The topic of a request by its local name, which may be given by the global one. What only comes in here is
        for its own site to set."""
        name = TopicName(str(request.get("topic", "")))
        known: Mapping[TopicName, TopicInfo] = self._bridge.outbound.known
        if name in known:
            return name
        site = self._bridge.site
        local = site.rules.inward(name, namespace=site.namespace)
        if local in known:
            return local
        for identity in self._bridge.inbound.streams:
            if identity.topic == name:
                raise UsageError(f"{name} comes from {identity.origin}; set it at that client")
        return name
