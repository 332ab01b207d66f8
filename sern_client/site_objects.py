"""The door to cross-reality objects for an endpoint, or any other part of a client."""

import time
from collections.abc import Callable

from sern_core.objects.xr_object import XrObject
from sern_core.site.client import ClientCore
from sern_core.site.object_mirror import ObjectListener
from sern_core.vocabulary.types import ObjectKind
from sern_runtime import clock


class CoreObjects:
    """`SiteObjects` of a client's core. `kick`: the link may have something to send."""

    def __init__(self, core: ClientCore, kick: Callable[[], None]) -> None:
        self._core = core
        self._kick = kick

    def put(
        self,
        object_id: str,
        kind: ObjectKind,
        type_name: str,
        *,
        value: bytes = b"",
        attributes: dict[str, str] | None = None,
        ros_stamp_ns: int | None = None,
    ) -> None:
        self._core.objects.put(
            object_id,
            kind,
            type_name,
            value=value,
            attributes=attributes,
            ros_stamp_ns=ros_stamp_ns,
            wall_ns=time.time_ns(),
            now=clock.now(),
        )
        self._kick()

    def delete(self, object_id: str) -> bool:
        deleted = self._core.objects.delete(object_id, now=clock.now())
        self._kick()
        return deleted

    def own(self, object_id: str) -> XrObject | None:
        return self._core.objects.registry.get(object_id)

    def listen(self, listener: ObjectListener) -> None:
        self._core.mirror.listeners.append(listener)
