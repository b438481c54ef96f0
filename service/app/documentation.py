"""The page at /docs: Swagger UI shows the OpenAPI document and sends requests to this service.

Swagger UI's files come unchanged from the package ``fastapi-offline``; the page and the script that starts it are in
``swagger_ui``.  Nothing is loaded from other sites, and all addresses are relative to the page, so that they hold
under whatever path a proxy publishes the service.
"""

from __future__ import annotations

from pathlib import Path

from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

PAGE = "page.html"

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-cache",
}

_files = StaticFiles(directory=Path(__file__).parent / "swagger_ui", packages=[("fastapi_offline", "static")])


async def documentation_file(name: str, scope: Scope) -> Response:
    """The page or a file that it loads; 304 if the caller has it.

    Raises:
        HTTPException: 404, there is no such file.
    """
    answer = await _files.get_response(name, scope)
    answer.headers.update(HEADERS)
    return answer
