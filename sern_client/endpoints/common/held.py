"""The subscription of an endpoint that keeps refused or earlier messages for it."""

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from sern_client.endpoints.base import Sink

T = TypeVar("T")


@dataclass(slots=True, eq=False)
class HeldSubscription(Generic[T]):
    """A `Subscription`: open while it is one of `subscriptions`, those of its topic. `held`: body and stamp in ns."""

    sink: Sink
    topic: T
    subscriptions: "list[HeldSubscription[T]]"
    held: deque[tuple[bytes, int]] = field(default_factory=deque)

    @property
    def closed(self) -> bool:
        return self not in self.subscriptions

    def close(self) -> None:
        self.held.clear()
        if self in self.subscriptions:
            self.subscriptions.remove(self)
