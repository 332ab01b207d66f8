"""Says what the keys of a section mean: the docstrings below the fields of its class, for schemas and the reference.

They are read from the source when somebody asks: a daemon never does, and would read every file of `config` at its
start.
"""

import ast
import inspect
import sys
from collections.abc import Iterable, Iterator
from functools import cache


def meaning(model: type, field: str) -> str | None:
    """The docstring of a field, of the class that declares it last; None: it has none."""
    for each in model.__mro__:
        if field in vars(each).get("__annotations__", {}):
            return _declared(each.__module__)[each.__qualname__][field]
    return None


@cache
def _declared(module: str) -> dict[str, dict[str, str | None]]:
    """The annotated names of each class of a module, with the docstrings below them."""
    return dict(_classes(ast.parse(inspect.getsource(sys.modules[module])).body, ""))


def _classes(body: Iterable[ast.stmt], within: str) -> Iterator[tuple[str, dict[str, str | None]]]:
    for statement in body:
        if isinstance(statement, ast.ClassDef):
            yield within + statement.name, _fields(statement.body)
            yield from _classes(statement.body, f"{within}{statement.name}.")


def _fields(body: list[ast.stmt]) -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for statement, below in zip(body, [*body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            text = below.value if isinstance(below, ast.Expr) else None
            says = text.value if isinstance(text, ast.Constant) else None
            found[statement.target.id] = inspect.cleandoc(says) if isinstance(says, str) else None
    return found
