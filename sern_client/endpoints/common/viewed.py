"""What an endpoint at which people look asks where its client has nothing on demand."""

from collections.abc import Sequence

from sern_client.endpoints.base import TopicNews
from sern_core.vocabulary.types import TopicName


class NothingOnDemand:
    """The `Viewed` of an endpoint that was given none: what comes is what the client's file subscribes to."""

    def want(self, name: TopicName, wanted: bool) -> None:
        """Nothing to do: it comes, or it does not."""

    def topics(self) -> Sequence[TopicNews]:
        return ()
