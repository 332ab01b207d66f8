"""Services that scenes offer: `__request` with a number and the request go to the scene, `__response` comes back."""

import itertools
import logging
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from sern_client.endpoints.base import ServiceEvents, ServiceInfo
from sern_client.endpoints.common.calls import PendingCalls, within
from sern_client.endpoints.unity import commands, names
from sern_client.endpoints.unity.commands import MAX_SRV_ID, Command, shown
from sern_client.endpoints.unity.far_services import MAX_CALLS, MAX_REGISTERED
from sern_client.endpoints.unity.faults import Fault, Faults
from sern_client.endpoints.unity.frames import frame
from sern_client.endpoints.unity.scene import Scene
from sern_client.endpoints.unity.types import SceneTypes
from sern_core.vocabulary.errors import ConfigError, ServiceError
from sern_core.vocabulary.types import DropReason, TopicName

FIRST_SRV_ID: Final = 1

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Offer:
    scene: Scene
    spelling: str
    info: ServiceInfo


@dataclass(slots=True)
class _Server:
    """A scene that serves. `asked`: the service of each call under way; `answers`: the number of the answer that comes
    next, by service."""

    offers: dict[str, _Offer] = field(default_factory=dict)
    next_id: int = FIRST_SRV_ID
    waiting: PendingCalls = field(default_factory=PendingCalls)
    asked: dict[int, str] = field(default_factory=dict)
    answers: dict[str, int] = field(default_factory=dict)


class OwnServices:
    """Those of one endpoint. Of two scenes that offer the same service the first one serves it; when it goes, the
    other does. Numbers of calls begin with `first_id`."""

    def __init__(
        self, types: SceneTypes, faults: Faults, drops: Counter[DropReason], *, first_id: int = FIRST_SRV_ID
    ) -> None:
        self._types = types
        self._faults = faults
        self._drops = drops
        self._first_id = first_id
        self._events: ServiceEvents | None = None
        self._offers: dict[TopicName, list[_Offer]] = {}
        self._servers: dict[Scene, _Server] = {}

    def watch(self, events: ServiceEvents) -> None:
        self._events = events
        for offers in self._offers.values():
            events.service_added(offers[0].info)

    async def call(self, name: TopicName, request: bytes, *, timeout_s: float) -> bytes:
        offers = self._offers.get(name)
        if not offers:
            raise ServiceError(f"no service {name}")
        scene, spelling = offers[0].scene, offers[0].spelling
        server = self._servers[scene]
        if len(server.waiting) >= MAX_CALLS:
            raise ServiceError(f"{name}: {MAX_CALLS} calls are under way already")
        number = _free(server)
        pieces = (commands.command(commands.REQUEST, srv_id=number), *frame(spelling, request))
        server.asked[number] = spelling
        try:
            with server.waiting.call(number) as answer:
                if not scene.outbox.service(pieces):
                    raise ServiceError(f"{name}: too much waits for the scene")
                scene.wake()
                async with within(timeout_s, f"{name} did not answer within {timeout_s:g} s"):
                    return await answer
        finally:
            del server.asked[number]
            if server.answers.get(spelling) == number:
                del server.answers[spelling]

    # --- of scenes --------------------------------------------------------------------------------------------------

    def offer(self, scene: Scene, command: Command) -> None:
        server = self._servers.setdefault(scene, _Server(next_id=self._first_id))
        try:
            name, type_name = names.local_name(command.topic), names.our_type(command.type_name, "srv")
        except ConfigError as error:
            self._faults(Fault.NAME, f"cannot offer a service: {error}", scene)
            return
        earlier = self._offers.get(name, [])
        if earlier and not names.same_type(earlier[0].info.type_name, type_name):
            text = (
                f"{name}: the scene offers {shown(command.type_name)}, and "
                f"{names.their_type(earlier[0].info.type_name)} is offered by that name already; it is not taken"
            )
            self._faults(Fault.OTHER_TYPE, text, scene)
            return
        if command.topic in server.offers:
            return
        if len(server.offers) >= MAX_REGISTERED:
            self._faults(Fault.TOO_MANY, f"cannot offer more than {MAX_REGISTERED} services", scene)
            return
        try:
            known = self._types.service(type_name)
        except ConfigError as error:
            self._faults(Fault.UNKNOWN_TYPE, f"cannot offer {name}: {error}", scene)
            return
        info = ServiceInfo(name, type_name, self._types.encoding, known.type_hash, known.definition)
        offer = server.offers[command.topic] = _Offer(scene, command.topic, info)
        self._offers.setdefault(name, []).append(offer)
        if earlier:
            scene.warn(f"another scene offers {name} already; this one does when that is gone")
            _log.info("%s: two scenes offer it; the second one serves when the first is gone", name)
            return
        if self._events is not None:
            if not self._events.wants_service(name):
                scene.warn(f"no site is offered {name}: name it under services.offer in the client's file")
            self._events.service_added(info)

    def remove(self, scene: Scene, spelling: str) -> None:
        server = self._servers.get(scene)
        offer = None if server is None else server.offers.pop(spelling, None)
        if offer is None:
            return
        name = offer.info.name
        offers = self._offers[name]
        served = offers[0] is offer
        offers.remove(offer)
        if not offers:
            del self._offers[name]
        if served and self._events is not None:
            self._events.service_removed(name)
            if offers:
                self._events.service_added(offers[0].info)

    def answers(self, scene: Scene, srv_id: int) -> None:
        """The next message of the scene from that service is the answer to the call of this number."""
        server = self._servers.get(scene)
        spelling = None if server is None else server.asked.get(srv_id)
        if server is None or spelling is None:
            text = "it answers a call that is not under way: it was too late, or its number is wrong"
            self._faults(Fault.CALL, text, scene)
            return
        server.answers[spelling] = srv_id

    def expects(self, scene: Scene, spelling: str) -> bool:
        """Whether an answer of this service is what comes next."""
        server = self._servers.get(scene)
        return server is not None and spelling in server.answers

    def serves(self, scene: Scene, spelling: str) -> bool:
        """Whether the scene offers a service."""
        server = self._servers.get(scene)
        return server is not None and spelling in server.offers

    def response(self, scene: Scene, spelling: str, body: bytes) -> None:
        """A message of a service that the scene offers, or was asked of."""
        server = self._servers[scene]
        number = server.answers.pop(spelling, None)
        if number is None:
            self._drops[DropReason.UNWANTED] += 1  # its call is over; that was told with its number
        elif self._types.is_body(body):
            server.waiting.answer(number, body)
        else:
            text = f"{shown(spelling)}: an answer of {len(body)} bytes is no body of {self._types.encoding}"
            self._faults(Fault.BODY, text, scene)
            server.waiting.fail(number, f"the scene gave no answer that can be read ({len(body)} bytes)")

    def gone(self, scene: Scene) -> None:
        server = self._servers.get(scene)
        if server is not None:
            for spelling in list(server.offers):
                self.remove(scene, spelling)
            del self._servers[scene]
            server.waiting.fail_all("the scene that serves it has gone")


def _free(server: _Server) -> int:
    """A number that no call under way has; there are more than calls."""
    for number in itertools.count(server.next_id):
        wrapped = (number - FIRST_SRV_ID) % MAX_SRV_ID + FIRST_SRV_ID
        if wrapped not in server.asked:
            server.next_id = wrapped % MAX_SRV_ID + FIRST_SRV_ID
            return wrapped
    raise AssertionError("numbers never end")
