"""Texts of requests in the one form in which they are stored and compared (:func:`core.names.composed`).

Path and query string are put into it here; JSON where it is parsed (:mod:`service.http.bodies`), names and fields of
forms where these are (:mod:`service.http.multipart`, :mod:`service.http.uploads`).
"""

from __future__ import annotations

from urllib.parse import parse_qsl, unquote_plus, urlencode

from starlette.types import ASGIApp, Receive, Scope, Send

from core.names import composed


class TextForm:
    """ASGI middleware that puts the path and the query string of a request into the one form of texts."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            scope["path"] = composed(scope["path"])
            scope["query_string"] = _composed_query(scope["query_string"])
        await self.app(scope, receive, send)


def _composed_query(query: bytes) -> bytes:
    """A query string whose names and values are in the one form; it has no letters but of ASCII, or it was refused."""
    if b"%" not in query:
        return query  # nearly always
    text = query.decode("latin-1")
    if (plain := unquote_plus(text)) == composed(plain):
        return query
    return urlencode([(composed(name), composed(value)) for name, value in parse_qsl(text, True)]).encode()
