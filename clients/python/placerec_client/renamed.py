"""Methods under names that they had once, or where they never were: the refusal names the one that does it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from placerec_client.errors import Renamed


class OldNames:
    """A class whose methods once had other names names the new one when an old one is used.

    The names are given with the class: ``class Keys(OldNames, revoke="delete")``.
    """

    _now: ClassVar[Mapping[str, str]] = {}

    def __init_subclass__(cls, **now: str) -> None:
        super().__init_subclass__()
        cls._now = now

    if not TYPE_CHECKING:  # so that a type checker still knows what there is

        def __getattr__(self, name: str) -> Any:
            if name in self._now:
                raise Renamed(type(self).__name__, name, self._now[name])
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)


DELETING = ("forget", "revoke", "end")
"""Words that some classes once had for ``delete``."""


class Subscripted:
    """A collection whose members have the methods: if one of these is called on it, the error says so."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            text = f"{type(self).__name__!r} object has no attribute {name!r}"
            now = "delete" if name in DELETING else name
            if not name.startswith("_") and hasattr(type(self["id"]), now):
                text += f"; one of them has it: {type(self).__name__.removeprefix('Async').lower()}[id].{now}"
            raise AttributeError(text, name=name, obj=self)
