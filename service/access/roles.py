"""Who may do what: one row for each operation.  A test fails for a route without a row, and for a row without a route.

The roles are ordered: whoever may ``enrol`` may also ``query``, and ``admin`` may do everything.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Role = Literal["open", "query", "enrol", "admin"]
"""What an operation needs: nothing at all, or a key of this role or a higher one."""

MapScope = Literal["none", "path", "named", "shown", "all"]
"""How a key that is limited to maps is held to them.

none: the operation has to do with no map.
path: the map in the path has to be one of the key's; looked at before the body is read.
named: besides the one in the path, each map that the request names has to be; the operation looks itself, by
    :meth:`service.access.gate.Principal.require`.
shown: only what is of the key's maps is there for it; the operation filters, by ``Principal.may_use``.
all: it tells of all maps together, so only a key without such a limit will do.
"""

LEVELS: dict[Role, int] = {"open": 0, "query": 1, "enrol": 2, "admin": 3}


@dataclass(frozen=True)
class Rule:
    """What one operation needs.

    role: the least role of a key.
    maps: how a key that is limited to maps is held to them.
    changes: the operation changes a map, or asks for a job that does: each call leaves a line in the audit trail.
    """

    role: Role
    maps: MapScope
    changes: bool = False


OPERATIONS: dict[str, Rule] = {
    # The root
    "check_liveness": Rule("open", "none"),
    "check_readiness": Rule("open", "shown"),  # which maps are damaged is told to those who may use them
    "read_version": Rule("open", "none"),
    "read_openapi": Rule("open", "none"),
    "read_documentation": Rule("open", "none"),
    "read_metrics": Rule("query", "all"),  # its series name every map
    # Maps
    "list_maps": Rule("query", "shown"),
    "read_map": Rule("query", "path"),
    "create_map": Rule("admin", "named", changes=True),
    "edit_map": Rule("admin", "path", changes=True),
    "delete_map": Rule("admin", "path", changes=True),
    "verify_map": Rule("admin", "path"),  # reads all that is stored, which takes the disk for long
    # Places, traverses, cameras: what an enrolment run brings, replaces and takes back
    "enrol_place": Rule("enrol", "path", changes=True),
    "enrol_places": Rule("enrol", "path", changes=True),
    "edit_place": Rule("enrol", "path", changes=True),
    "forget_place": Rule("enrol", "path", changes=True),
    "list_places": Rule("query", "path"),
    "read_place": Rule("query", "path"),
    "see_thumbnail": Rule("query", "path"),
    "list_sequences": Rule("query", "path"),
    "delete_sequence": Rule("enrol", "path", changes=True),
    "list_cameras": Rule("query", "path"),
    "read_camera": Rule("query", "path"),
    "put_camera": Rule("enrol", "path", changes=True),
    "forget_camera": Rule("enrol", "path", changes=True),
    # Queries
    "query": Rule("query", "path"),
    "query_batch": Rule("query", "path"),
    "query_maps": Rule("query", "named"),  # without names: of the key's maps
    "query_or_enrol": Rule("enrol", "path", changes=True),
    "see_explanation": Rule("query", "path"),
    # Sessions belong to their map: whoever may query it may use them, and they change nothing in it
    "create_session": Rule("query", "path"),
    "list_sessions": Rule("query", "path"),
    "read_session": Rule("query", "path"),
    "delete_session": Rule("query", "path"),
    "send_frame": Rule("query", "path"),
    "stream_frames": Rule("query", "path"),
    # Upkeep: what changes how all robots are answered, or takes long
    "calibrate_map": Rule("admin", "path", changes=True),
    "check_health": Rule("enrol", "path"),
    "reencode_map": Rule("admin", "named", changes=True),  # the new map's id, too
    "prune_map": Rule("admin", "path", changes=True),
    "export_map": Rule("admin", "path"),  # all that a map holds, pictures too
    "import_map": Rule("admin", "named", changes=True),
    "rebuild_map": Rule("admin", "path", changes=True),
    "merge_map": Rule("admin", "named", changes=True),  # the other map, too
    # Jobs: those of the key's maps; a job over several needs all of them
    "list_jobs": Rule("query", "shown"),
    "read_job": Rule("query", "shown"),
    "follow_job": Rule("query", "shown"),
    "cancel_job": Rule("enrol", "shown", changes=True),  # and the role that asking for the job needs
    # Frames without a map, and what is installed
    "encode": Rule("query", "none"),
    "regions": Rule("query", "none"),
    "match": Rule("query", "none"),
    "list_encoders": Rule("query", "none"),
}
"""Operation ids are the names of the functions, WebSockets' too."""

ROLES: dict[str, Role] = {operation: rule.role for operation, rule in OPERATIONS.items()}

FORGOTTEN = Rule("admin", "all", changes=True)
"""For a route without a row, which the tests do not let pass."""


_TOLD: dict[MapScope, str] = {
    "path": "; if it is limited to maps, this has to be one of them",
    "named": "; if it is limited to maps, all that are named have to be among them",
    "shown": "; if it is limited to maps, there is nothing else here for it",
    "all": ", without a limit to maps",
    "none": "",
}


def needs(rule: Rule) -> str:
    """What key an operation needs, as a sentence."""
    role = "any role" if rule.role == "query" else f"the role `{rule.role}`"
    return f"Where keys are asked for: a key of {role}{_TOLD[rule.maps]}."


def covers(role: Role, needed: Role) -> bool:
    """Whether a key of one role may do what needs another."""
    return LEVELS[role] >= LEVELS[needed]
