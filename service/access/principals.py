"""Who asks: what is known of a caller once access control has let it in."""

from __future__ import annotations

import re
from contextvars import ContextVar
from dataclasses import dataclass

from service.access.roles import Role
from service.errors.faults import MapForbidden

TOKEN = re.compile(r"placerec_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
"""A key as its holder sends it: its id, and a secret of 256 bits."""


@dataclass(frozen=True)
class Principal:
    """A caller.

    name: of its key; for logs and the audit trail.
    key_id: None without a key.
    role: query, enrol or admin.
    maps: ids of the maps that it is limited to; None: all.
    """

    name: str
    key_id: str | None
    role: Role
    maps: frozenset[str] | None

    def may_use(self, *map_ids: str | None) -> bool:
        """Whether all of these maps are its own; None, for what is of no map, is there for keys of all maps alone."""
        return self.maps is None or all(map_id in self.maps for map_id in map_ids)

    def require(self, *map_ids: str) -> None:
        """Refuse it a map that is not its own, whether or not there is one of that id.

        Raises:
            MapForbidden: at least one is not.
        """
        for map_id in map_ids:
            if not self.may_use(map_id):
                raise MapForbidden(f"The key {self.name!r} is limited to other maps than {map_id[:80]!r}.")


ANONYMOUS = Principal("anonymous", None, "admin", None)
"""Whoever reaches a service that has no keys."""

OWNER = Principal("owner", None, "admin", None)
"""Whoever opened the data directory itself: a command without --url."""

NOBODY = Principal("nobody", None, "open", frozenset())
"""Who asks for what is open to all, and has no key."""


@dataclass(frozen=True)
class Asker:
    """Who asked for a change, and by which request; a job keeps it, so that its end can be told with it."""

    principal: str
    key: str | None = None
    operation: str | None = None
    request_id: str | None = None
    trace_id: str | None = None
    client: str | None = None


ASKER: ContextVar[Asker] = ContextVar("asker", default=Asker("owner"))  # noqa: B039 - frozen
"""Who asks for what is being done now; it goes along into threads."""
