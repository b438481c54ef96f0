"""Routes that export a map as one file and import it again."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from pydantic import AfterValidator, Field
from starlette.responses import JSONResponse, Response

from core import errors
from core.maps.archives.manifest import Manifest
from core.places import check_map_id
from service.errors.faults import (
    BodyTooLarge,
    ExportGone,
    JobQueueFull,
    RangeNotSatisfiable,
    TooManyExports,
    TooManyImports,
    TooManyMaps,
    TooManyPlaces,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.bodies import intake_of
from service.http.headers import check_match, entity_tag, is_known, named_tags
from service.http.openapi import BINARY
from service.http.routing import EngineDep, FromState, MapId, PrincipalDep, StrictRoute, single_values
from service.http.schemas import Parameters
from service.http.uploads import media_type
from service.jobs.routes import JobsDep, accepted
from service.jobs.schemas import JobView
from service.maps.exports import MEDIA_TYPE, ExportResponse, Exports
from service.maps.imports import Imports
from service.maps.limits import check_new_map
from service.maps.routes import show_map
from service.maps.schemas import MapView
from service.queries.answers import StatisticsDep
from service.worker_threads import in_thread, to_its_end

ExportsDep = Annotated[Exports, Depends(FromState("exports"))]
ImportsDep = Annotated[Imports, Depends(FromState("imports"))]

router = APIRouter(prefix="/v1/maps", tags=["transfer"], route_class=StrictRoute, dependencies=[Depends(single_values)])

MEDIA_TYPES = (MEDIA_TYPE, "application/octet-stream")

HEADERS = {
    "ETag": {
        "description": "The SHA-256 of the manifest, which identifies the file.",
        "schema": {"type": "string"},
    },
    "Accept-Ranges": {"description": "bytes", "schema": {"type": "string"}},
}


class ImportParameters(Parameters):
    """How a file is imported."""

    id: Annotated[str, AfterValidator(check_map_id)] | None = Field(
        default=None, description="Id of the new map; if left out, the one that the file states.", examples=["lab"]
    )
    encoder: str | None = Field(
        default=None, max_length=256, description="Name or identity of the encoder that the map is expected to have."
    )
    background: bool = Field(
        default=False, description="Answer 202 as soon as the file has arrived; a job makes the map."
    )


@router.get(
    "/{map}/export",
    response_class=Response,
    responses={
        200: {
            "description": "The whole file.",
            "content": {MEDIA_TYPE: {"schema": BINARY}},
            "headers": {**HEADERS, "Content-Length": {"schema": {"type": "integer"}}},
        },
        206: {
            "description": "The part of the file that Range asks for.",
            "content": {MEDIA_TYPE: {"schema": BINARY}},
            "headers": {**HEADERS, "Content-Range": {"schema": {"type": "string"}}},
        },
        304: {"description": "The map has not changed: its file is the one that If-None-Match names."},
        **problem_documentation(ExportGone, RangeNotSatisfiable, TooManyExports, errors.StorageFull),
    },
)
async def export_map(map_id: MapId, request: Request, engine: EngineDep, exports: ExportsDep) -> Response:
    """Download a map as one file: a tar of its settings, places, descriptors, pictures and cameras.

    The file shows the map as it was when the download began, even if places are enrolled or deleted meanwhile;
    `docs/reference/exports.md` describes its contents. An interrupted download can be continued with `Range` and
    `If-Range` (or `If-Match`) as long as the service keeps the export. With `If-None-Match` the answer is 304 if
    the map has not changed. The manifest contains the SHA-256 of every part, and the ETag is the SHA-256 of the
    manifest.
    """
    export = exports.find(map_id, named_tags(request.headers))
    if export is None:
        map_ = await engine.map(map_id)
        tag = await exports.tag_of(map_)
        if tag is None or not is_known(request.headers, tag):
            export = await exports.create(map_)
            tag = export.file.tag
    else:
        tag = export.file.tag
    headers = {
        "ETag": f'"{tag}"',
        "Cache-Control": "private, no-cache",
        "Content-Disposition": f'attachment; filename="{map_id}.tar"',
    }
    check_match(request.headers, tag)
    if export is None or is_known(request.headers, tag):
        return Response(status_code=304, headers={**headers, "Accept-Ranges": "bytes"})
    return ExportResponse(exports, export, headers)


BODY: dict[str, Any] = {
    "parameters": [
        {
            "name": name,
            "in": "header",
            "required": False,
            "description": f"`sha-256=:…:` or `sha-512=:…:` (RFC 9530), digests of the {what}; 422 if it has others.",
            "schema": {"type": "string"},
        }
        for name, what in (("Content-Digest", "body"), ("Repr-Digest", "file, which the body is"))
    ],
    "requestBody": {
        "required": True,
        "description": "A file that was exported.",
        "content": {kind: {"schema": BINARY} for kind in MEDIA_TYPES},
    },
}


@router.post(
    "/import",
    status_code=201,
    openapi_extra=BODY,
    response_model=MapView,
    responses={
        202: {"model": JobView, "description": "The job that makes the map, if `background` is true."},
        **problem_documentation(
            errors.InvalidIdentifier,
            errors.MapExists,
            errors.WrongEncoder,
            errors.InvalidArchive,
            errors.ArchiveTooNew,
            errors.StorageFull,
            errors.StorageFailure,
            JobQueueFull,
            TooManyImports,
            TooManyMaps,
            TooManyPlaces,
            UnsupportedMediaType,
        ),
    },
)
async def import_map(
    request: Request,
    options: Annotated[ImportParameters, Query()],
    engine: EngineDep,
    jobs: JobsDep,
    imports: ImportsDep,
    statistics: StatisticsDep,
    principal: PrincipalDep,
) -> Response:
    """Import a map that this or another service exported; it is listed only after all of it was checked.

    The body is the exported file. It is refused as soon as its beginning shows that it cannot become a map here, for
    example because its encoder is not installed or the id is taken. With `background` the answer is a job that makes
    the map from the file, and that goes on after a restart.
    """
    kind = media_type(request)
    if kind not in MEDIA_TYPES:
        raise UnsupportedMediaType(f"Send a map as {' or '.join(MEDIA_TYPES)}, not as {kind[:80] or 'nothing'}.")
    if options.background:
        await in_thread(jobs.check_room)
    settings = engine.settings
    if options.id is not None:
        principal.require(options.id)
        await in_thread(check_new_map, engine, jobs, options.id)
    length = request.headers.get("content-length", "")
    announced = int(length) if length.isdigit() else 0
    if announced > settings.max_import_bytes:
        raise BodyTooLarge(f"The file is larger than the {settings.max_import_bytes} bytes that are allowed.")
    intake = intake_of(request)
    intake.pass_on(settings.max_import_bytes, settings.import_timeout)

    def accept(manifest: Manifest) -> str:
        # The right comes first: who may not use a map must not learn whether it exists.
        principal.require(options.id or manifest.map.id)
        return imports.check_manifest(manifest, options.id, options.encoder)

    received = await imports.receive(request.stream(), announced, accept)
    request.state.noted = {"map": received.map_id, "manifest": received.tag}
    if options.background:
        job = await to_its_end(lambda: imports.submit(received))
        return accepted(job, settings)
    await imports.build(received)
    map_ = await engine.map(received.map_id)
    view = await in_thread(show_map, engine, statistics, map_, {})  # it has no queries yet
    headers = {
        "ETag": entity_tag(map_.record.revision),
        "Location": f"{settings.root_path}{router.prefix}/{received.map_id}",
    }
    return JSONResponse(view.model_dump(mode="json"), 201, headers)
