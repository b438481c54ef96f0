"""Routes at the root (liveness, readiness, metrics, version, documentation), and the list of encoders."""

from __future__ import annotations

import json
import platform
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated

import faiss
from fastapi import APIRouter, Depends, FastAPI, Request
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.responses import Response

from service.app.documentation import PAGE, documentation_file
from service.app.runtime import Runtime
from service.app.schemas import EncoderPage, Health, OpenState, Readiness, Version
from service.errors.faults import NotReady
from service.errors.problems import problem_documentation
from service.http.routing import EngineDep, FromState, PrincipalDep, single_values
from service.maps.schemas import QuarantinedMap
from service.open_files import most_open_files, open_files
from service.worker_threads import in_thread

RuntimeDep = Annotated[Runtime, Depends(FromState("runtime"))]

router = APIRouter(tags=["service"])


@router.get("/livez")
async def check_liveness() -> Health:
    """Check that the process answers; this is cheap, and meant for a supervisor that restarts it."""
    return Health()


@router.get("/readyz", responses=problem_documentation(NotReady))
async def check_readiness(runtime: RuntimeDep, principal: PrincipalDep) -> Readiness:
    """Check that the service can answer queries: the encoder reproduces its golden values, and maps can be read.

    A full disk takes no writes, but does not make the service unready: it is `degraded`, and says why. A damaged map
    does not either; it is listed here if the key may use it. Addresses are named to admins alone.
    """
    found = await runtime.check_readiness()
    found.require(principal.confided)
    engine = runtime.engine
    damaged = engine.maps.quarantined().items()
    quarantined = [QuarantinedMap(id=name, reason=reason) for name, reason in damaged if principal.may_use(name)]
    return Readiness(
        degraded=None if found.degraded is None else found.degraded.told(principal.confided),
        checks=found.told_checks(principal.confided),
        encoder=runtime.settings.encoder,
        quarantined=quarantined,
        open=OpenState(
            maps=engine.maps.open_maps,
            most_maps=engine.most_open_maps,
            files=open_files(),
            most_files=most_open_files(),
        ),
    )


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "The text format of Prometheus.", "content": {"text/plain": {}}}},
)
async def read_metrics(engine: EngineDep, runtime: RuntimeDep) -> Response:
    """Read the metrics for Prometheus."""
    await runtime.check_readiness()  # one of them says whether it is degraded
    return Response(await in_thread(engine.metrics.expose), media_type=CONTENT_TYPE_LATEST)


@router.get("/version")
async def read_version(request: Request, engine: EngineDep) -> Version:
    """Read the versions of the service and its libraries."""
    return Version(
        version=request.app.version,
        encoder=engine.settings.encoder,
        python=platform.python_version(),
        torch=_version_of("torch"),
        faiss=faiss.__version__,
    )


def _version_of(distribution: str) -> str | None:
    """The version of a package, which is not loaded for it; None: it is not installed."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


@router.get("/openapi.json", include_in_schema=False)
async def read_openapi(request: Request) -> Response:
    """Read the OpenAPI document."""
    return Response(_openapi_json(request.app), media_type="application/json")


@router.get("/docs", include_in_schema=False)
async def read_documentation(request: Request) -> Response:
    """Read the documentation of this interface; the page loads nothing from other sites."""
    return await documentation_file(PAGE, request.scope)


@router.get("/docs/{file}", include_in_schema=False)
async def read_documentation_file(file: str, request: Request) -> Response:
    """Read a file that the page of documentation loads."""
    return await documentation_file(file, request.scope)


@lru_cache(1)  # needs no key, and takes as long as a query
def _openapi_json(app: FastAPI) -> bytes:
    return json.dumps(app.openapi(), ensure_ascii=False, separators=(",", ":")).encode()


encoders = APIRouter(prefix="/v1/encoders", tags=["encoders"], dependencies=[Depends(single_values)])


@encoders.get("")
def list_encoders(engine: EngineDep) -> EncoderPage:
    """List the installed encoders and their definitions, including damaged ones."""
    return EncoderPage(items=engine.catalogue.describe(), next_cursor=None)
