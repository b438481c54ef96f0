"""Where an answer leads: OpenAPI links from an operation to those that go on with what it made."""

from __future__ import annotations

from typing import Any

_MAP = {"map": "$request.path.map"}
_MADE_MAP = {"map": "$response.body#/id"}
_PLACE = _MAP | {"place": "$request.path.place"}
_CAMERA = _MAP | {"camera": "$request.path.camera"}
_SESSION = _MAP | {"session": "$response.body#/id"}
_SAME_SESSION = _MAP | {"session": "$request.path.session"}
_MADE_JOB = {"job": "$response.body#/id"}
_JOB = {"job": "$request.path.job"}

LINKS: dict[str, dict[str, dict[str, dict[str, str]]]] = {
    "create_map": {
        "201": dict.fromkeys(
            (
                "read_map",
                "edit_map",
                "delete_map",
                "verify_map",
                "list_places",
                "query",
                "create_session",
                "list_cameras",
                "check_health",
                "reencode_map",
                "prune_map",
                "calibrate_map",
            ),
            _MADE_MAP,
        )
    },
    "delete_map": {"204": dict.fromkeys(("read_map", "list_places"), _MAP)},
    "enrol_place": {
        "201": dict.fromkeys(("read_place", "edit_place", "see_thumbnail", "forget_place"), _PLACE)
        | dict.fromkeys(("query", "list_places", "list_sequences"), _MAP)
    },
    "forget_place": {"204": {"read_place": _PLACE}},
    "put_camera": {"201": dict.fromkeys(("read_camera", "forget_camera"), _CAMERA)},
    "forget_camera": {"204": {"read_camera": _CAMERA}},
    "create_session": {"201": dict.fromkeys(("send_frame", "read_session", "delete_session"), _SESSION)},
    "delete_session": {"204": {"read_session": _SAME_SESSION}},
    "reencode_map": {"202": dict.fromkeys(("read_job", "cancel_job"), _MADE_JOB)},
    "prune_map": {"202": dict.fromkeys(("read_job", "cancel_job"), _MADE_JOB)},
    "merge_map": {"202": dict.fromkeys(("read_job", "cancel_job"), _MADE_JOB)},
    "cancel_job": {"200": {"read_job": _JOB}},
}
"""Operation -> status -> operation that can follow -> its parameters, as runtime expressions."""


def tell_links(operation: dict[str, Any]) -> None:
    """Add an operation's links to its OpenAPI ``responses``."""
    for status, targets in LINKS.get(operation["operationId"], {}).items():
        operation["responses"][status]["links"] = {
            target: {"operationId": target, "parameters": parameters} for target, parameters in targets.items()
        }
