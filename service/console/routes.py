"""Routes of the console: the page, and the files that it loads.  They need no key; the page's requests do."""

from __future__ import annotations

from fastapi import APIRouter, HTTPException, Request
from starlette.responses import RedirectResponse, Response

from service.console.files import ConsoleFile, console_files
from service.http.headers import accepts_gzip, is_known

router = APIRouter(include_in_schema=False)

POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob: data:",  # pictures are fetched with the key, and shown from memory
        "media-src blob:",
        "connect-src 'self'",
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",  # a text can nowhere become markup
        "trusted-types 'none'",
    )
)

HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Vary": "Accept-Encoding",
}

REVALIDATED = "no-cache"
IMMUTABLE = "public, max-age=31536000, immutable"


@router.get("/console")
async def read_console(request: Request) -> Response:
    """Read the page of the console."""
    return _answer(request, console_files().page, REVALIDATED)


@router.get("/console/")
async def find_console(request: Request) -> Response:
    """Go to the page, whose addresses are relative to the path without the slash."""
    return RedirectResponse("../console", 308)


@router.get("/console/{build}/{file:path}")
async def read_console_file(build: str, file: str, request: Request) -> Response:
    """Read a file that the page loads; one of another version of the service is not there."""
    files = console_files()
    found = files.others.get(file) if build == files.build else None
    if found is None:
        raise HTTPException(404)
    return _answer(request, found, IMMUTABLE)


def _answer(request: Request, file: ConsoleFile, caching: str) -> Response:
    headers = {**HEADERS, "Cache-Control": caching, "ETag": f'"{file.tag}"'}
    if is_known(request.headers, file.tag):
        return Response(status_code=304, headers=headers)
    if accepts_gzip(request.headers.get("accept-encoding")):
        return Response(file.compressed, media_type=file.media_type, headers=headers | {"Content-Encoding": "gzip"})
    return Response(file.content, media_type=file.media_type, headers=headers)
