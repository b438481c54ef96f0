"""Routes of frames without a map: the descriptor or the regions of a frame, and the score of two frames."""

from __future__ import annotations

import base64
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from starlette.responses import JSONResponse, Response

from core import errors
from core.method.region_drawing import boxes, draw, layer_grids, strongest
from core.recognition.recognition import no_regions
from service.engine.encoders import Encoded
from service.errors.faults import (
    QueueFull,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.frames.schemas import (
    Box,
    Descriptor,
    EncoderParameters,
    Layer,
    MatchParameters,
    MatchScore,
    Region,
    RegionsParameters,
    RegionsView,
)
from service.http.headers import preferred
from service.http.openapi import BINARY, form_body, frame_body
from service.http.routing import (
    DeadlineDep,
    EngineDep,
    milliseconds_since,
    rounded,
    single_values,
    started,
)
from service.http.uploads import read_frame, read_pair
from service.queries.explanations import draw_explanation, explain_pair, scaled_for_drawing
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1",
    tags=["frames"],
    dependencies=[Depends(single_values)],
    responses=problem_documentation(
        errors.TooManyPixels, UnsupportedMediaType, errors.NotAnImage, errors.UnknownEncoder, QueueFull
    ),
)
JSON, OCTETS, PNG = "application/json", "application/octet-stream", "image/png"


@router.post(
    "/encode",
    response_model=Descriptor,
    openapi_extra=frame_body(EncoderParameters),
    responses={
        200: {"description": "The descriptor.", "content": {OCTETS: {"schema": BINARY}}},
        **problem_documentation(errors.NoRegions),
    },
)
async def encode(
    options: Annotated[EncoderParameters, Query()], request: Request, engine: EngineDep, deadline: DeadlineDep
) -> Response:
    """The descriptor of a frame, float32: base64 in JSON, or the bytes alone (`Accept: application/octet-stream`).

    The bytes are little-endian; the headers `X-Encoder` and `X-Regions` give the encoder and the number of regions.
    """
    engine.queue.check_room()
    frame = await read_frame(request, engine.settings)
    identity = await in_thread(engine.resolve, options.joined(frame.fields).encoder)
    with engine.queue.place():
        encoded = await engine.queue.encode(identity, frame.data, deadline)
    regions = len(encoded.encoding.regions)
    if regions == 0:
        raise no_regions(encoded.few_values)
    values = encoded.encoding.descriptor.astype("<f4").tobytes()
    if preferred(request.headers.get("accept"), JSON, OCTETS) == OCTETS:
        return Response(values, headers={"X-Encoder": identity, "X-Regions": str(regions)}, media_type=OCTETS)
    described = Descriptor(
        encoder=identity,
        dimension=len(encoded.encoding.descriptor),
        descriptor=base64.b64encode(values).decode(),
        regions=regions,
        milliseconds=_times(request, encoded),
    )
    return JSONResponse(described.model_dump())


@router.post(
    "/regions",
    response_model=RegionsView,
    openapi_extra=frame_body(RegionsParameters),
    responses={200: {"description": "The regions.", "content": {PNG: {"schema": BINARY}}}},
)
async def regions(
    options: Annotated[RegionsParameters, Query()], request: Request, engine: EngineDep, deadline: DeadlineDep
) -> Response:
    """The regions of interest of a frame: as JSON, or drawn (`?format=png`, or `Accept: image/png`)."""
    engine.queue.check_room()
    frame = await read_frame(request, engine.settings)
    options = options.joined(frame.fields)
    identity = await in_thread(engine.resolve, options.encoder)
    with engine.queue.place():
        encoded = await engine.queue.encode(identity, frame.data, deadline)
    found = encoded.encoding.regions
    layers = await in_thread(layer_grids, encoded.encoder)
    chosen = strongest(found, options.limit)
    wanted = options.format or ("png" if preferred(request.headers.get("accept"), JSON, PNG) == PNG else "json")
    if wanted == "png":
        drawn = await in_thread(draw, encoded.pixels, found, chosen, list(layers.values()))
        return Response(drawn, headers={"X-Encoder": identity, "X-Regions": str(len(found))}, media_type=PNG)
    height, width = encoded.pixels.shape[:2]
    names = list(layers)
    corners = np.round(boxes(found, list(layers.values()), width, height), 2)
    view = RegionsView(
        encoder=identity,
        width=width,
        height=height,
        layers=[Layer(name=name, rows=rows, columns=columns) for name, (rows, columns) in layers.items()],
        found=len(found),
        regions=[
            Region(
                layer=names[found.layers[index]],
                channel=int(found.channels[index]),
                energy=float(found.energies[index]),
                cells=tuple(found.boxes[index].tolist()),
                box=Box(**dict(zip(("left", "top", "right", "bottom"), corners[index].tolist(), strict=True))),
            )
            for index in chosen
        ],
        milliseconds=_times(request, encoded),
    )
    return JSONResponse(view.model_dump())


@router.post(
    "/match",
    response_model=MatchScore,
    openapi_extra=form_body(
        "Two frames.",
        {
            "a": BINARY,
            "b": BINARY,
            "encoder": {"type": "string"},
            "explain": {"type": "boolean"},
            "format": {"type": "string", "enum": ["json", "png"]},
        },
        ["a", "b"],
    ),
    responses={200: {"description": "The score.", "content": {PNG: {"schema": BINARY}}}},
)
async def match(
    options: Annotated[MatchParameters, Query()], request: Request, engine: EngineDep, deadline: DeadlineDep
) -> Response:
    """The score of two frames: near 0 for unrelated frames, and at most 1.

    A frame with plain parts does not reach 1 even against itself.
    """
    engine.queue.check_room()
    first, second, fields = await read_pair(request, engine.settings)
    options = options.joined(fields)
    identity = await in_thread(engine.resolve, options.encoder)
    wanted = options.format or ("png" if preferred(request.headers.get("accept"), JSON, PNG) == PNG else "json")
    with engine.queue.place():
        a = await in_thread(scaled_for_drawing, await engine.queue.encode(identity, first, deadline))
        b = await engine.queue.encode(identity, second, deadline)
    both = {stage: a.milliseconds[stage] + b.milliseconds[stage] for stage in a.milliseconds}
    explanation = await in_thread(explain_pair, a, b) if options.explain or wanted == "png" else None
    if explanation is not None and wanted == "png":
        drawn = await in_thread(draw_explanation, explanation, a.pixels, b.pixels)
        return Response(drawn, headers={"X-Encoder": identity, "X-Score": str(explanation.score)}, media_type=PNG)
    score = MatchScore(
        score=a.encoder.score(a.encoding, b.encoding),
        encoder=identity,
        regions={"a": len(a.encoding.regions), "b": len(b.encoding.regions)},
        explanation=explanation,
        milliseconds=rounded({**both, "total": milliseconds_since(started(request))}),
    )
    return JSONResponse(score.model_dump(exclude_none=True))


def _times(request: Request, encoded: Encoded) -> dict[str, float]:
    return rounded({**encoded.milliseconds, "total": milliseconds_since(started(request))})
