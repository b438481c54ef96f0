"""Maps as files: download one, bring one."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from pydantic import AfterValidator, Field
from starlette.responses import JSONResponse, Response

from core import errors
from core.places import check_map_id
from service.errors.faults import (
    BodyTooLarge,
    DigestMismatch,
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
from service.http.dependencies import EngineDep, FromState, MapId, PrincipalDep, single_values
from service.http.headers import check_match, entity_tag, is_known, named_tags, wanted_slice
from service.http.openapi import BINARY
from service.http.route_classes import StrictRoute
from service.http.schemas import Parameters
from service.http.uploads import media_type
from service.jobs.routes import JobsDep, accepted
from service.jobs.schemas import JobView
from service.maps.exports import MEDIA_TYPE, ExportResponse, Exports
from service.maps.imports import Imports, wanted_digests
from service.maps.limits import check_free
from service.maps.routes import show_map
from service.maps.schemas import MapView
from service.worker_threads import in_thread, to_its_end

ExportsDep = Annotated[Exports, Depends(FromState("exports"))]

router = APIRouter(prefix="/v1/maps", tags=["transfer"], route_class=StrictRoute, dependencies=[Depends(single_values)])

MEDIA_TYPES = (MEDIA_TYPE, "application/octet-stream")

HEADERS = {
    "ETag": {"description": "Names the bytes: the SHA-256 of the manifest.", "schema": {"type": "string"}},
    "Accept-Ranges": {"description": "bytes", "schema": {"type": "string"}},
}


class ImportParameters(Parameters):
    """What becomes of a file."""

    id: Annotated[str, AfterValidator(check_map_id)] | None = Field(
        default=None, description="Id of the map that is made; the file's own if left out.", examples=["lab"]
    )
    encoder: str | None = Field(
        default=None, max_length=256, description="Name or identity of the encoder that the caller expects."
    )
    background: bool = Field(default=False, description="Answer as soon as the file is there; a job makes the map.")


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
            "description": "The part of it that Range names.",
            "content": {MEDIA_TYPE: {"schema": BINARY}},
            "headers": {**HEADERS, "Content-Range": {"schema": {"type": "string"}}},
        },
        304: {"description": "The map holds what If-None-Match names."},
        **problem_documentation(ExportGone, RangeNotSatisfiable, TooManyExports, errors.StorageFull),
    },
)
async def export_map(map_id: MapId, request: Request, engine: EngineDep, exports: ExportsDep) -> Response:
    """Download a map as one file: a tar of its settings, places, descriptors, pictures and cameras.

    The file is that of one moment, whatever is enrolled or deleted while it is on its way;
    `docs/reference/exports.md` tells what it holds. A download that broke off goes on with `Range` and `If-Range`
    (or `If-Match`), as long as that moment is kept. `If-None-Match` answers 304 for a map that holds what it held.
    The SHA-256 of every part stands in the manifest, that of the manifest in the ETag.
    """
    export = exports.find(map_id, named_tags(request.headers))
    if export is None:
        export = await exports.take(await engine.map(map_id))
    archive = export.archive
    headers = {
        "ETag": f'"{archive.tag}"',
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "Content-Disposition": f'attachment; filename="{map_id}.tar"',
    }
    check_match(request.headers, archive.tag)
    if is_known(request.headers, archive.tag):
        return Response(status_code=304, headers=headers)
    # A range is of what GET gives (RFC 9110, section 14.2).
    alone = request.state.method == "HEAD"
    part = wanted_slice({**request.headers, **({"range": ""} if alone else {})}, archive.tag, archive.size)
    headers["Content-Length"] = str(part.stop - part.start)
    if alone:
        return Response(None, headers={**headers, "Content-Type": MEDIA_TYPE})
    if part.is_whole:
        return ExportResponse(exports, export, part, 200, headers)
    return ExportResponse(exports, export, part, 206, {**headers, "Content-Range": part.content_range})


BODY: dict[str, Any] = {
    "parameters": [
        {
            "name": name,
            "in": "header",
            "required": False,
            "description": f"RFC 9530: `sha-256=:…:`, the SHA-256 of the {what}; 422 if it has another one.",
            "schema": {"type": "string"},
        }
        for name, what in (("Content-Digest", "body"), ("Repr-Digest", "file, which the body is"))
    ],
    "requestBody": {
        "required": True,
        "description": "A file that an export gave.",
        "content": {kind: {"schema": BINARY} for kind in MEDIA_TYPES},
    },
}


@router.post(
    "/import",
    status_code=201,
    openapi_extra=BODY,
    response_model=MapView,
    responses={
        202: {"model": JobView, "description": "The job that does it, if `background` is asked for."},
        **problem_documentation(
            errors.InvalidIdentifier,
            errors.MapExists,
            errors.WrongEncoder,
            errors.InvalidArchive,
            errors.ArchiveTooNew,
            errors.StorageFull,
            errors.StorageFailure,
            DigestMismatch,
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
    imports: Annotated[Imports, Depends(FromState("imports"))],
    principal: PrincipalDep,
) -> Response:
    """Bring a map that was exported, here or elsewhere; it is listed when all of it was checked, or not at all.

    The body is the file as it was downloaded. It is written to disk as it arrives, and refused as soon as it is
    known that it cannot become a map here: for its encoder, its version, its id. With `background` the answer is a
    job that makes the map of the file, over a restart too.
    """
    kind = media_type(request)
    if kind not in MEDIA_TYPES:
        raise UnsupportedMediaType(f"A map is sent as {' or '.join(MEDIA_TYPES)}, not as {kind[:80] or 'nothing'}.")
    if options.background:
        jobs.check_room()
    settings = engine.settings
    if options.id is not None:
        principal.require(options.id)
        await in_thread(check_free, engine, jobs, options.id)
    length = request.headers.get("content-length", "")
    announced = int(length) if length.isdigit() else 0
    if announced > settings.max_import_bytes:
        raise BodyTooLarge(f"The file has more than the {settings.max_import_bytes} bytes that are taken here.")
    intake_of(request).pass_on(settings.max_import_bytes, settings.import_timeout)

    def accept(manifest: Any) -> str:
        principal.require(options.id or str(manifest.map.id))  # first: whether there is one is not told to everybody
        return imports.check(manifest, options.id, options.encoder)

    arrived = await imports.receive(request.stream(), announced, wanted_digests(request.headers), accept)
    request.state.noted = {"map": arrived.map_id, "manifest": arrived.tag}
    if options.background:
        job = await to_its_end(lambda: imports.submit(arrived))
        return accepted(job, settings)
    await imports.build(arrived)
    map_ = await engine.map(arrived.map_id)
    view = await in_thread(show_map, engine, map_)
    headers = {
        "ETag": entity_tag(map_.record.revision),
        "Location": f"{settings.root_path}{router.prefix}/{arrived.map_id}",
    }
    return JSONResponse(view.model_dump(mode="json"), 201, headers)
