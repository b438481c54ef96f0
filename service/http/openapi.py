"""The OpenAPI document: bodies that routes parse themselves, common problems, required roles, and links."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel

from core import errors
from service.access.roles import OPERATIONS, UNLISTED, Rule, needs
from service.errors import faults
from service.errors.problems import MEDIA_TYPE, Problem, document_problems, problem_examples
from service.http.uploads import FORM, FORMATS

BINARY = {"type": "string", "format": "binary"}
NAMED = {"minLength": 1}
"""Every part of a form has a name."""

COMPONENT = "#/components/schemas/"
REQUEST_ID = {
    "description": "The id of the request: the one that it was sent with, or a new one. It is also in the log.",
    "schema": {"type": "string"},
}

# The problems that all operations of a group have in common.  Those of a layer before all resources (keys, rates, the
# limits of a connection) are named here, so that a route names only its own.
COMMON: tuple[type[Exception], ...] = (
    faults.MalformedHead,
    faults.HeadTooSlow,
    faults.UrlTooLong,
    faults.HeadTooLarge,
    faults.UnknownTransferCoding,
    faults.TooManyConnections,
    faults.Stopping,
)
"""Problems of every operation."""

COMMON_V1: tuple[type[Exception], ...] = (faults.InvalidRequest,)
"""Problems of every operation under /v1."""

COMMON_OF_BODIES: tuple[type[Exception], ...] = (
    faults.MalformedBody,
    faults.BodyTooLarge,
    faults.UnsupportedMediaType,
    faults.DigestMismatch,
    faults.MemoryFull,
    faults.DeadlineExceeded,
)
"""Problems of every operation that takes a body."""

COMMON_OF_MAPS: tuple[type[Exception], ...] = (
    errors.UnknownMap,
    errors.InvalidIdentifier,
    errors.StorageFailure,
    errors.TooManyOpenFiles,
    errors.MapQuarantined,
)
"""Problems of every operation on one map."""


SECURITY_SCHEME = {
    "type": "http",
    "scheme": "bearer",
    "description": "A key of this service, `placerec_…`. It is needed as soon as a key was ever created. Without "
    "keys, requests from web pages of other sites are refused.",
}


def _access_problems(rule: Rule) -> list[type[Exception]]:
    if rule.role == "open":
        return []
    found = [faults.KeyNeeded, faults.KeyRefused, faults.ForeignPage, faults.RateExceeded, faults.KeysUnreadable]
    found += [faults.RoleTooLow] if rule.role != "query" else []
    found += [faults.MapForbidden] if rule.maps in ("path", "named", "all") else []
    return found


def _tell_access(operation: dict[str, Any], rule: Rule) -> None:
    """Document the key that an operation needs."""
    operation["x-role"] = rule.role
    operation["security"] = [] if rule.role == "open" else [{"key": []}, {}]
    if rule.role != "open":
        operation["description"] = f"{operation.get('description', '')}\n\n{needs(rule)}".strip()


def _common_problems(path: str, operation: dict[str, Any], rule: Rule) -> list[type[Exception]]:
    found = [*COMMON, *_access_problems(rule)]
    found += COMMON_V1 if path.startswith("/v1/") else ()
    found += COMMON_OF_BODIES if "requestBody" in operation else ()
    found += COMMON_OF_MAPS if path.startswith("/v1/maps/{map}") else ()
    return found


def _form_fields(parameters: type[BaseModel]) -> dict[str, Any]:
    properties: dict[str, Any] = parameters.model_json_schema(ref_template=COMPONENT + "{model}")["properties"]
    return properties


def frame_body(parameters: type[BaseModel]) -> dict[str, Any]:
    """The body of an operation on one frame: the raw frame, or a form with the parameters as fields."""
    form = {
        "type": "object",
        "propertyNames": NAMED,
        "required": ["image"],
        "properties": {
            "image": {**BINARY, "description": "The frame; its part may have any name."},
            **_form_fields(parameters),
        },
    }
    content: dict[str, Any] = {kind: {"schema": BINARY} for kind in FORMATS}
    content[FORM] = {"schema": form, "encoding": {"image": {"contentType": ", ".join(FORMATS)}}}
    return {"requestBody": {"required": True, "description": "A JPEG, PNG or WebP file.", "content": content}}


def frames_body(parameters: type[BaseModel]) -> dict[str, Any]:
    """The body of an operation on the frames of one moment: a raw frame, or a form with one part for each camera."""
    form = {
        "type": "object",
        "propertyNames": NAMED,
        "properties": _form_fields(parameters),
        "additionalProperties": {**BINARY, "description": "The frame of one camera, under any name."},
    }
    content: dict[str, Any] = {kind: {"schema": BINARY} for kind in FORMATS}
    content[FORM] = {"schema": form}
    return {"requestBody": {"required": True, "description": "JPEG, PNG or WebP files.", "content": content}}


def form_body(description: str, properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    """The body of an operation on several frames."""
    schema = {
        "type": "object",
        "propertyNames": NAMED,
        "required": required,
        "properties": properties,
        "additionalProperties": BINARY,
    }
    return {"requestBody": {"required": True, "description": description, "content": {FORM: {"schema": schema}}}}


def json_patch(changes: type[BaseModel]) -> dict[str, Any]:
    """The body of an edit, which may also have the content type of a merge patch."""
    schema = {"$ref": COMPONENT + changes.__name__}
    return {"requestBody": {"content": {"application/merge-patch+json": {"schema": schema}}}}


# Links (operations that can follow on an answer)

_MAP = {"map": "$request.path.map"}
_MADE_MAP = {"map": "$response.body#/id"}
_PLACE = _MAP | {"place": "$request.path.place"}
_CAMERA = _MAP | {"camera": "$request.path.camera"}
_SESSION = _MAP | {"session": "$response.body#/id"}
_SAME_SESSION = _MAP | {"session": "$request.path.session"}
_MADE_KEY = {"key": "$response.body#/id"}
_MADE_JOB = {"job": "$response.body#/id"}
_JOB = {"job": "$request.path.job"}

LINKS: dict[str, dict[str, dict[str, dict[str, str]]]] = {
    "create_key": {"201": dict.fromkeys(("read_key", "narrow_key", "delete_key"), _MADE_KEY)},
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
                "align_map",
                "calibrate_map",
            ),
            _MADE_MAP,
        )
    },
    "delete_map": {"204": dict.fromkeys(("read_map", "list_places"), _MAP)},
    "enrol_place": {
        "201": dict.fromkeys(("read_place", "edit_place", "see_thumbnail", "delete_place"), _PLACE)
        | dict.fromkeys(("query", "list_places", "list_sequences"), _MAP)
    },
    "delete_place": {"204": {"read_place": _PLACE}},
    "put_camera": {"201": dict.fromkeys(("read_camera", "delete_camera"), _CAMERA)},
    "delete_camera": {"204": {"read_camera": _CAMERA}},
    "create_session": {"201": dict.fromkeys(("send_frame", "read_session", "delete_session"), _SESSION)},
    "delete_session": {"204": {"read_session": _SAME_SESSION}},
    "reencode_map": {"202": dict.fromkeys(("read_job", "cancel_job"), _MADE_JOB)},
    "prune_map": {"202": dict.fromkeys(("read_job", "cancel_job"), _MADE_JOB)},
    "align_map": {"202": dict.fromkeys(("read_job", "cancel_job"), _MADE_JOB)},
    "merge_map": {"202": dict.fromkeys(("read_job", "cancel_job"), _MADE_JOB)},
    "cancel_job": {"200": {"read_job": _JOB}},
}
"""The links of the document: for an operation and a status, which operations can follow and with which parameters.

The parameters are runtime expressions of OpenAPI.
"""


def tell_links(operation: dict[str, Any]) -> None:
    """Add an operation's links to its OpenAPI ``responses``."""
    for status, targets in LINKS.get(operation["operationId"], {}).items():
        operation["responses"][status]["links"] = {
            target: {"operationId": target, "parameters": parameters} for target, parameters in targets.items()
        }


# The whole document


def _complete(path: str, operation: dict[str, Any]) -> None:
    responses = operation["responses"]
    invalid = responses.get("422", {}).get("content", {}).get("application/json")
    if invalid is not None:  # the framework's own format of validation errors, which is never sent
        del responses["422"]["content"]["application/json"]
        if not responses["422"]["content"]:
            del responses["422"]
    rule = OPERATIONS.get(operation["operationId"], UNLISTED)
    _tell_access(operation, rule)
    document_problems(responses, _common_problems(path, operation, rule), str)
    tell_links(operation)
    responses["default"] = {
        "description": "Any other problem.",
        "content": {MEDIA_TYPE: {"schema": {"$ref": COMPONENT + "Problem"}}},
    }
    for response in responses.values():
        response.setdefault("headers", {})["X-Request-Id"] = {"$ref": "#/components/headers/X-Request-Id"}


def _share_problems(operation: dict[str, Any], shared: dict[str, Any]) -> None:
    """Move an operation's responses that are problems to ``shared``, under a name made of the kinds of problem."""
    for status, response in operation["responses"].items():
        problems = response.get("content", {}).get(MEDIA_TYPE)
        if problems is not None and len(response["content"]) == 1:
            name = ".".join(problems.get("examples", {"problem": None}))
            assert shared.setdefault(name, response) == response, name
            operation["responses"][status] = {"$ref": f"#/components/responses/{name}"}


def document(app: FastAPI, models: Iterable[type[BaseModel]] = ()) -> dict[str, Any]:
    """The application's OpenAPI document; it is made once and cached.

    Args:
        models: models of bodies that routes parse themselves, and of events, which the framework does not find.
    """
    if app.openapi_schema is None:
        made = get_openapi(
            title=app.title,
            version=app.version,
            summary=app.summary,
            description=app.description,
            tags=app.openapi_tags,
            routes=app.routes,
        )
        schemas = made["components"]["schemas"]
        unseen: list[type[BaseModel]] = [Problem, *models]
        for model in unseen:
            described = model.model_json_schema(ref_template=COMPONENT + "{model}")
            for name, nested in described.pop("$defs", {}).items():
                schemas.setdefault(name, nested)
            schemas[model.__name__] = described
        made["components"]["headers"] = {"X-Request-Id": REQUEST_ID}
        made["components"]["examples"] = problem_examples()
        shared: dict[str, Any] = {}
        made["components"]["responses"] = shared
        made["components"]["securitySchemes"] = {"key": SECURITY_SCHEME}
        for unused in ("HTTPValidationError", "ValidationError"):
            schemas.pop(unused, None)
        for path, item in made["paths"].items():
            for operation in item.values():
                _complete(path, operation)
                _share_problems(operation, shared)
        app.openapi_schema = made
    return app.openapi_schema
