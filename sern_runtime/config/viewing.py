"""What endpoints have in common at which people look."""

from typing import Annotated, Any, Final

from pydantic import Discriminator, Tag

from sern_runtime.config.base import Pattern, unexpected


def _tag(value: Any) -> str | None:
    """Which member of the union a value is meant to be."""
    return "bool" if isinstance(value, bool) else "list" if isinstance(value, (list, tuple)) else None


_EXPECTED: Final = unexpected("true, false or a list of patterns")

Publishable = Annotated[
    Annotated[bool, Tag("bool")] | Annotated[tuple[Pattern, ...], Tag("list")],
    Discriminator(
        _tag,
        custom_error_type=_EXPECTED.type,
        custom_error_message=_EXPECTED.message_template,
        custom_error_context=_EXPECTED.context,
    ),
]
"""What whoever connects may publish: all, nothing, or patterns of names."""
