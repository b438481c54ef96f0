"""At the root: is it alive, is it ready, what does it count, what is it."""

from __future__ import annotations

import json
import platform
from functools import lru_cache
from typing import Annotated

import faiss
import torch
from fastapi import APIRouter, Depends, FastAPI, Request
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.responses import HTMLResponse, Response

from service.app.documentation import SECURITY_POLICY, page
from service.app.runtime import Runtime
from service.app.schemas import EncoderPage, Health, Readiness, Version
from service.errors.faults import NotReady
from service.errors.problems import problem_documentation
from service.http.dependencies import EngineDep, FromState, PrincipalDep, single_values
from service.maps.schemas import QuarantinedMap
from service.worker_threads import in_thread

RuntimeDep = Annotated[Runtime, Depends(FromState("runtime"))]

router = APIRouter(tags=["service"])


@router.get("/livez")
async def check_liveness() -> Health:
    """Whether the process answers; cheap, for a supervisor that restarts it."""
    return Health()


@router.get("/readyz", responses=problem_documentation(NotReady))
async def check_readiness(runtime: RuntimeDep, principal: PrincipalDep) -> Readiness:
    """Whether frames can be served: encoder loaded and true to its golden values, maps open, disk writable.

    A damaged map does not make the service unready; it is named here to whoever may use it.
    """
    checks = await runtime.check_readiness()
    damaged = runtime.engine.atlas.quarantined().items()
    quarantined = [QuarantinedMap(id=name, reason=reason) for name, reason in damaged if principal.may_use(name)]
    return Readiness(checks=checks, encoder=runtime.settings.encoder, quarantined=quarantined)


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus's text format.", "content": {"text/plain": {}}}},
)
async def read_metrics(engine: EngineDep) -> Response:
    """The counters for Prometheus."""
    return Response(await in_thread(engine.metrics.expose), media_type=CONTENT_TYPE_LATEST)


@router.get("/version")
async def read_version(request: Request, engine: EngineDep) -> Version:
    """What runs here."""
    return Version(
        version=request.app.version,
        encoder=engine.settings.encoder,
        python=platform.python_version(),
        torch=torch.__version__,
        faiss=faiss.__version__,
    )


@router.get("/openapi.json", include_in_schema=False)
async def read_openapi(request: Request) -> Response:
    """This interface, described for machines."""
    return Response(_written(request.app), media_type="application/json")


@router.get("/docs", include_in_schema=False)
async def read_documentation(request: Request) -> Response:
    """This interface, described for people; the page needs nothing from elsewhere."""
    return HTMLResponse(_shown(request.app), headers={"Content-Security-Policy": SECURITY_POLICY})


@lru_cache(1)  # everybody may ask, and making it anew takes as long as a query
def _written(app: FastAPI) -> bytes:
    return json.dumps(app.openapi(), ensure_ascii=False, separators=(",", ":")).encode()


@lru_cache(1)
def _shown(app: FastAPI) -> bytes:
    return page(app.openapi()).encode()


encoders = APIRouter(prefix="/v1/encoders", tags=["encoders"], dependencies=[Depends(single_values)])


@encoders.get("")
def list_encoders(engine: EngineDep) -> EncoderPage:
    """List the models and vocabularies installed here, damaged ones too, with what they are made of."""
    return EncoderPage(items=engine.catalogue.describe(), next_cursor=None)
