"""Methods by the names that they had once: each is refused, and the one that does it now is named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from placerec_client.errors import Renamed

NOW: Mapping[str, str] = {"forget": "delete", "forget_many": "delete_many", "revoke": "delete", "end": "delete"}


class OldNames:
    """What has no method of a name that is in ``NOW``, but the one that takes its place, says so when it is asked."""

    if not TYPE_CHECKING:  # so that a type checker still knows what there is

        def __getattr__(self, name: str) -> Any:
            new = NOW.get(name)
            if new is not None and hasattr(type(self), new):
                raise Renamed(type(self).__name__, name, new)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
