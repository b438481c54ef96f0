"""How bodies that are read by hand stand in the OpenAPI document, and what every operation can answer."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel

from service.parameters import BatchItem
from service.problems import MEDIA_TYPE, Problem, problem_examples
from service.schemas.calibration import CalibrationOrder
from service.settings import Settings
from service.uploads import FORM, FORMATS

BINARY = {"type": "string", "format": "binary"}
COMPONENT = "#/components/schemas/"
REQUEST_ID = {
    "description": "Taken from the request or made; it stands in the log.",
    "schema": {"type": "string"},
}


def _form_fields(parameters: type[BaseModel]) -> dict[str, Any]:
    properties: dict[str, Any] = parameters.model_json_schema(ref_template=COMPONENT + "{model}")["properties"]
    return properties


def frame_body(parameters: type[BaseModel]) -> dict[str, Any]:
    """The body of an operation on one frame: raw, or a form with the parameters as fields."""
    form = {
        "type": "object",
        "required": ["image"],
        "properties": {"image": {**BINARY, "description": "The frame; any name will do."}, **_form_fields(parameters)},
    }
    content: dict[str, Any] = {kind: {"schema": BINARY} for kind in FORMATS}
    content[FORM] = {"schema": form, "encoding": {"image": {"contentType": ", ".join(FORMATS)}}}
    return {"requestBody": {"required": True, "description": "A JPEG, PNG or WebP file.", "content": content}}


def frames_body(parameters: type[BaseModel]) -> dict[str, Any]:
    """The body of an operation on the frames of one moment: a raw one, or a form of one part for each camera."""
    form = {
        "type": "object",
        "properties": _form_fields(parameters),
        "additionalProperties": {**BINARY, "description": "One camera's frame, under any name."},
    }
    content: dict[str, Any] = {kind: {"schema": BINARY} for kind in FORMATS}
    content[FORM] = {"schema": form}
    return {"requestBody": {"required": True, "description": "JPEG, PNG or WebP files.", "content": content}}


def form_body(description: str, properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    """The body of an operation on several frames."""
    schema = {
        "type": "object",
        "required": required,
        "properties": properties,
        "additionalProperties": BINARY,
    }
    return {"requestBody": {"required": True, "description": description, "content": {FORM: {"schema": schema}}}}


def json_patch(changes: type[BaseModel]) -> dict[str, Any]:
    """The body of an edit may also say that it is a merge patch."""
    schema = {"$ref": COMPONENT + changes.__name__}
    return {"requestBody": {"content": {"application/merge-patch+json": {"schema": schema}}}}


def _complete(operation: dict[str, Any]) -> None:
    responses = operation["responses"]
    invalid = responses.get("422", {}).get("content", {}).get("application/json")
    if invalid is not None:  # the framework's own form of validation errors, which is never sent
        del responses["422"]["content"]["application/json"]
        if not responses["422"]["content"]:
            del responses["422"]
    responses["default"] = {
        "description": "Any other problem.",
        "content": {MEDIA_TYPE: {"schema": {"$ref": COMPONENT + "Problem"}}},
    }
    for response in responses.values():
        response.setdefault("headers", {})["X-Request-Id"] = {"$ref": "#/components/headers/X-Request-Id"}


def document(app: FastAPI) -> dict[str, Any]:
    """The application's OpenAPI document; made once."""
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
        for model in (Problem, BatchItem, CalibrationOrder):
            described = model.model_json_schema(ref_template=COMPONENT + "{model}")
            schemas.update(described.pop("$defs", {}))
            schemas[model.__name__] = described
        made["components"]["headers"] = {"X-Request-Id": REQUEST_ID}
        made["components"]["examples"] = problem_examples()
        for unused in ("HTTPValidationError", "ValidationError"):
            schemas.pop(unused, None)
        for item in made["paths"].values():
            for operation in item.values():
                _complete(operation)
        app.openapi_schema = made
    return app.openapi_schema


def write_document(path: Path) -> None:
    """Write the document of an application with default settings."""
    from service.app import create_app  # the application is made of routes, which need this module

    made = document(create_app(Settings(host="127.0.0.1")))
    path.write_text(json.dumps(made, indent=2, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    write_document(Path(sys.argv[1]))
