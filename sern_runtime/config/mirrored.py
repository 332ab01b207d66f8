"""Sections that are the options of a part: a key for each field of a frozen dataclass, with its default and its checks.

`SectionOf[PlannerOptions]` is such a section; `made()` are the options. What a key means is what the dataclass says
below its field.
"""

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar, get_args, get_origin, get_type_hints

from pydantic import Field, GetJsonSchemaHandler, create_model, model_validator
from pydantic_core import CoreSchema

from sern_core.vocabulary.errors import UsageError
from sern_runtime.config.base import Section, fault
from sern_runtime.config.meanings import meaning

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options", bound="DataclassInstance")
AS_IN_NAV2: Final = "As Nav2 has it."
"""What is said of a key whose dataclass says nothing."""


class Mirror(Section):
    """What all of them share."""

    mirrors: ClassVar[type["DataclassInstance"]]

    @model_validator(mode="after")
    def _fit(self) -> "Mirror":
        try:
            self.made()
        except UsageError as error:
            raise fault(str(error)) from error
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Its fields have their descriptions from the dataclass."""
        return handler(core_schema)

    def made(self, **given: object) -> Any:
        """The options. `given`: what no file says. UsageError: they do not fit together."""
        values = {name: _made(getattr(self, name)) for name in type(self).model_fields}
        return self.mirrors(**(values | given))


if TYPE_CHECKING:

    class SectionOf(Section, Generic[Options]):
        """The section whose keys are the fields of Options."""

        def made(self, **given: object) -> Options: ...

else:

    class SectionOf:
        """The section whose keys are the fields of Options."""

        def __class_getitem__(cls, options: type) -> type[Mirror]:
            return section_of(options)


LEFT_OUT: Final[dict[type, frozenset[str]]] = {}
"""Fields that are no keys, by dataclass: their values come from elsewhere."""


@cache
def section_of(options: type["DataclassInstance"]) -> type[Mirror]:
    """The section of a dataclass. All of its fields have defaults."""
    hints = get_type_hints(options)
    fields: dict[str, Any] = {}
    for each in dataclasses.fields(options):
        if each.name in LEFT_OUT.get(options, ()):
            continue
        default = each.default if each.default_factory is dataclasses.MISSING else each.default_factory()
        says = meaning(options, each.name) or AS_IN_NAV2
        given = {} if default is dataclasses.MISSING else {"default": _mirrored(default)}
        fields[each.name] = (_hint(hints[each.name]), Field(**given, description=says))
    name = options.__name__.removesuffix("Options") + "Keys"
    made = create_model(name, __base__=Mirror, __doc__=_about(options), **fields)
    made.mirrors = options
    return made


def _about(options: type) -> str:
    """The docstring up to what it raises, which the section says as an error."""
    text = (options.__doc__ or "").split("UsageError:")[0].strip()
    own = text and not text.startswith(f"{options.__name__}(")  # which dataclasses make up
    return text if own else f"{options.__name__.removesuffix('Options')}."


def _hint(hint: Any) -> Any:
    """The type of a key for the type of a field: sections in place of dataclasses, at any depth."""
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return section_of(hint)
    if get_origin(hint) is tuple:
        return tuple[tuple(_hint(each) if each is not ... else ... for each in get_args(hint))]  # type: ignore[misc]
    return hint


def _mirrored(value: Any) -> Any:
    """A default, with sections in place of options."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = section_of(type(value))
        values = {name: _mirrored(getattr(value, name)) for name in kind.model_fields}
        return kind.model_construct(**values)
    if isinstance(value, tuple):
        return tuple(map(_mirrored, value))
    return value


def _made(value: Any) -> Any:
    if isinstance(value, Mirror):
        return value.made()
    if isinstance(value, tuple):
        return tuple(map(_made, value))
    return value


def leave_out(fields: Mapping[type, frozenset[str]]) -> None:
    """Fields that are to be no keys; before the first section of theirs is made."""
    LEFT_OUT.update(fields)
