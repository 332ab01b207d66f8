"""Lists of names that travel in several control messages. Pure."""

from sern_core.vocabulary.errors import WireError


class NameLists:
    """Lists of a session, by the message that they are in and its channel."""

    def __init__(self, max_names: int) -> None:
        self._max_names = max_names
        self._parts: dict[tuple[str, int], list[str]] = {}  # more of them will come
        self._unfinished = 0  # names in them

    def begin(self) -> None:
        """A session has begun."""
        self._parts.clear()
        self._unfinished = 0

    def add(self, key: tuple[str, int], names: tuple[str, ...], *, more: bool, peer: str) -> tuple[str, ...] | None:
        """The names of a list once it is complete, else None. Raises WireError if `peer` leaves too much unfinished."""
        if more:
            self._unfinished += len(names)
            if self._unfinished > self._max_names:
                raise WireError(f"{peer} leaves lists of more than {self._max_names} names unfinished")
            if names:
                self._parts.setdefault(key, []).extend(names)
            return None
        if key not in self._parts:
            return names
        parts = self._parts.pop(key)
        self._unfinished -= len(parts)
        return (*parts, *names)
