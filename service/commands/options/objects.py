"""Commands with many options: a dataclass lists them, and the command takes one object of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature
from typing import Any, TypeVar, get_type_hints

Options = TypeVar("Options")


def takes(options: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Make a function of one object into a command for Typer, with a parameter for each field of the object.

    Args:
        options: a dataclass. Its fields are annotated as Typer's parameters are, ``Annotated[int, typer.Option(...)]``;
            one whose type is a dataclass stands for the fields of that, in this place.

    Raises:
        ValueError: two fields have the same name.
    """
    signature = Signature(list(_parameters(options)))

    def decorate(command: Callable[[Options], None]) -> Callable[..., None]:
        @wraps(command)
        def run(**given: Any) -> None:
            command(_filled(options, given))

        run.__signature__ = signature  # type: ignore[attr-defined]
        run.__annotations__ = {name: one.annotation for name, one in signature.parameters.items()}
        return run

    return decorate


def _parameters(options: type[Any]) -> Iterator[Parameter]:
    for name, hint, default in _fields(options):
        if is_dataclass(hint):
            yield from _parameters(hint)
        else:
            yield Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def _filled(options: type[Options], given: Mapping[str, Any]) -> Options:
    values = {name: _filled(hint, given) if is_dataclass(hint) else given[name] for name, hint, _ in _fields(options)}
    return options(**values)


def _fields(options: type[Any]) -> Iterator[tuple[str, type[Any], Any]]:
    """Name, annotated type and default of each field."""
    hints = get_type_hints(options, include_extras=True)
    for field in fields(options):
        yield field.name, hints[field.name], Parameter.empty if field.default is MISSING else field.default
