"""Who may do what: callers, their roles, and a rule for each operation.

The roles are ordered: ``enrol`` includes ``query``, and ``admin`` includes everything.  A test fails for a route
without a rule, and for a rule without a route.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from service.errors.faults import MapForbidden

Role = Literal["open", "query", "enrol", "admin"]
"""The lowest role that an operation needs; "open": no key at all."""

LEVELS: dict[Role, int] = {"open": 0, "query": 1, "enrol": 2, "admin": 3}


TOKEN = re.compile(r"placerec_([0-9a-f]{12})_([A-Za-z0-9_-]{43})")
"""The text of a key: its id, and a secret of 256 bits."""


def covers(role: Role, needed: Role) -> bool:
    """Whether a caller of one role may do what needs another."""
    return LEVELS[role] >= LEVELS[needed]


@dataclass(frozen=True)
class Principal:
    """A caller that was let in.

    Args:
        name: of its key; it appears in logs and in the audit trail.
        key_id: None without a key.
        role: of its holder.
        maps: ids of the maps that it is limited to; None for all maps.
        learn: whether maps may learn from its runs; an option of the role ``enrol``.
    """

    name: str
    key_id: str | None
    role: Role
    maps: frozenset[str] | None
    learn: bool = False

    @property
    def teaches(self) -> bool:
        """Whether maps may learn from its runs."""
        return self.role == "admin" or (self.learn and covers(self.role, "enrol"))

    @property
    def confided(self) -> bool:
        """Whether it may know addresses, paths and peers of the installation: with an admin's key for all maps."""
        return self == OWNER or (self.key_id is not None and self.role == "admin" and self.maps is None)

    def may_use(self, *map_ids: str | None) -> bool:
        """Whether it may use all of these maps; None, for what belongs to no map, needs a key for all maps."""
        return self.maps is None or all(map_id in self.maps for map_id in map_ids)

    def require(self, *map_ids: str) -> None:
        """Refuse maps that it may not use, whether or not they exist.

        Raises:
            MapForbidden: it may not use at least one of them.
        """
        for map_id in map_ids:
            if not self.may_use(map_id):
                raise MapForbidden(f"The key {self.name!r} is limited to certain maps; {map_id[:80]!r} is not one.")


ANONYMOUS = Principal("anonymous", None, "admin", None)
"""A caller of a service that has no keys."""

OWNER = Principal("owner", None, "admin", None)
"""A caller that opened the data directory itself: a command without --url."""

NOBODY = Principal("nobody", None, "open", frozenset())
"""A caller without a valid key, who may use only what is open to all."""


MapScope = Literal["none", "path", "named", "shown", "all"]
"""How an operation treats a key that is limited to some maps.

none: the operation involves no map.
path: the map in the path has to be one of the key's; this is checked before the body is read.
named: every map that the request names, in the path or elsewhere, has to be one of the key's; the operation checks
    them with :meth:`Principal.require`.
shown: the operation shows only what belongs to the key's maps; it filters with :meth:`Principal.may_use`.
all: the operation shows all maps together, so it needs a key without a limit.
"""


@dataclass(frozen=True)
class Rule:
    """The requirements of one operation.

    Args:
        role: the lowest role that may call it.
        maps: how it treats a key that is limited to some maps.
        changes: whether it changes a map, or starts a job that does; each call is then written to the audit trail.
        shows: whether it gives out pictures of a map, or all of it; that is written to the audit trail, too.
    """

    role: Role
    maps: MapScope
    changes: bool = False
    shows: bool = False


OPERATIONS: dict[str, Rule] = {
    # The root
    "check_liveness": Rule("open", "none"),
    "check_readiness": Rule("open", "shown"),  # it names damaged maps only to callers that may use them
    "read_version": Rule("open", "none"),
    "read_openapi": Rule("open", "none"),
    "read_documentation": Rule("open", "none"),
    "read_documentation_file": Rule("open", "none"),
    "read_service": Rule("query", "shown"),  # memory, disk and settings only to admins for all maps
    "read_history": Rule("admin", "all"),
    "read_metrics": Rule("query", "all"),  # its series name all maps
    # The console's own files; their requests need a key like any other request
    "read_console": Rule("open", "none"),
    "find_console": Rule("open", "none"),
    "read_console_file": Rule("open", "none"),
    # Keys and the audit trail: they show all maps and all callers
    "read_own_key": Rule("query", "none"),
    "list_keys": Rule("admin", "all"),
    "create_key": Rule("admin", "all", changes=True),
    "read_key": Rule("admin", "all"),
    "narrow_key": Rule("admin", "all", changes=True),
    "delete_key": Rule("admin", "all", changes=True),
    "read_audit": Rule("admin", "all"),
    # Maps
    "list_maps": Rule("query", "shown"),
    "read_map": Rule("query", "path"),
    "create_map": Rule("admin", "named", changes=True),
    "edit_map": Rule("admin", "path", changes=True),
    "delete_map": Rule("admin", "path", changes=True),
    "follow_map": Rule("query", "path", shows=True),  # pictures need the role enrol, which also sees the callers
    "verify_map": Rule("admin", "path"),  # it reads all that is stored, which keeps the disk busy
    # Places, traverses, cameras: the objects that an enrolment creates, replaces and deletes
    "enrol_place": Rule("enrol", "path", changes=True),
    "enrol_places": Rule("enrol", "path", changes=True),
    "compare_places": Rule("enrol", "path"),
    "read_recording": Rule("enrol", "path"),
    "upload_recording": Rule("enrol", "path", changes=True),
    "enrol_recording": Rule("enrol", "path", changes=True),
    "delete_recording": Rule("enrol", "path", changes=True),
    "edit_place": Rule("enrol", "path", changes=True),
    "delete_place": Rule("enrol", "path", changes=True),
    "delete_places": Rule("enrol", "path", changes=True),
    "add_look": Rule("enrol", "path", changes=True),
    "delete_look": Rule("enrol", "path", changes=True),
    "delete_learnt_looks": Rule("enrol", "path", changes=True),
    "list_looks": Rule("query", "path"),
    "list_all_looks": Rule("query", "path"),
    "see_look": Rule("query", "path", shows=True),
    "list_places": Rule("query", "path"),
    "read_place": Rule("query", "path"),
    "see_thumbnail": Rule("query", "path", shows=True),
    "read_plan": Rule("query", "path"),
    "check_coverage": Rule("query", "path"),
    "list_sequences": Rule("query", "path"),
    "delete_sequence": Rule("enrol", "path", changes=True),
    "list_cameras": Rule("query", "path"),
    "read_camera": Rule("query", "path"),
    "put_camera": Rule("enrol", "path", changes=True),
    "delete_camera": Rule("enrol", "path", changes=True),
    # Queries
    "query": Rule("query", "path"),
    "query_batch": Rule("query", "path"),
    "query_maps": Rule("query", "named"),  # without names it asks the key's maps
    "query_or_enrol": Rule("enrol", "path", changes=True),
    "list_answers": Rule("query", "path"),
    "list_place_matches": Rule("query", "path"),
    "see_explanation": Rule("query", "path", shows=True),
    # Review: its frames are what robots saw, and labels change how the map is calibrated
    "list_review": Rule("enrol", "path"),
    "see_review_picture": Rule("enrol", "path", shows=True),
    "export_labels": Rule("enrol", "path", shows=True),
    "label_frame": Rule("enrol", "path", changes=True),
    "list_stretches": Rule("enrol", "path"),
    "accept_stretch": Rule("enrol", "path", changes=True),
    "reject_stretch": Rule("enrol", "path", changes=True),
    # Sessions: they change nothing in their map, so a key that may query it may use them
    "create_session": Rule("query", "path"),
    "list_sessions": Rule("query", "path"),
    "read_session": Rule("query", "path"),
    "read_fleet": Rule("query", "shown"),
    "delete_session": Rule("query", "path"),
    "send_frame": Rule("query", "path"),
    "stream_frames": Rule("query", "path"),
    "align_map": Rule("enrol", "path", changes=True),  # it changes of places what an edit of each could change
    # Upkeep: it changes the answers to all robots, or takes long
    "read_calibration": Rule("query", "path"),
    "calibrate_map": Rule("admin", "path", changes=True),
    "compare_traverses": Rule("query", "path"),
    "check_health": Rule("enrol", "path"),
    "reencode_map": Rule("admin", "named", changes=True),  # it names the new map, too
    "prune_map": Rule("admin", "path", changes=True),
    "erase_frames": Rule("admin", "path", changes=True),  # it deletes what people have labelled, too
    "list_backups": Rule("admin", "all"),
    "schedule_backups": Rule("admin", "all", changes=True),
    "back_up": Rule("admin", "all", changes=True),
    "export_map": Rule("admin", "path", shows=True),  # it reads all of a map, with its pictures
    "import_map": Rule("admin", "named", changes=True),
    "rebuild_map": Rule("admin", "path", changes=True),
    "fill_keypoints": Rule("admin", "path", changes=True),
    "merge_map": Rule("admin", "named", changes=True),  # it names the other map, too
    # Jobs: a job over several maps is shown to a key for all of them
    "list_jobs": Rule("query", "shown"),
    "read_job": Rule("query", "shown"),
    "follow_job": Rule("query", "shown"),
    "cancel_job": Rule("enrol", "shown", changes=True),  # and the role that the operation behind the job needs
    # Frames without a map, and the installed encoders
    "encode": Rule("query", "none"),
    "regions": Rule("query", "none"),
    "match": Rule("query", "none"),
    "list_encoders": Rule("query", "none"),
}
"""The rules by operation id, which is the name of the route's function."""

UNLISTED = Rule("admin", "all", changes=True)
"""The rule of a route that has none, which the tests do not let pass."""

_LIMITS: dict[MapScope, str] = {
    "path": "; a key that is limited to certain maps must include this one",
    "named": "; a key that is limited to certain maps must include all that are named",
    "shown": "; a key that is limited to certain maps sees only those",
    "all": " that is not limited to certain maps",
    "none": "",
}


def needs(rule: Rule) -> str:
    """A sentence about the key that an operation needs."""
    role = "any role" if rule.role == "query" else f"the role `{rule.role}`"
    return f"If the service has keys, this needs a key of {role}{_LIMITS[rule.maps]}."
