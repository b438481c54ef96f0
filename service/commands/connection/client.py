"""The client of the commands, which talks to a service at a URL or runs the application in this process.

Without a URL the application runs here, without a socket, under the exclusive lock of the data directory; the requests
take the same routes either way.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import AsyncIterator, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar
from urllib.parse import quote

import httpx
import typer

from core.errors import DataDirectoryLocked
from service.commands.connection.credentials import VARIABLE, given_key, headers_for, is_unencrypted
from service.commands.console import Failure, remark

if TYPE_CHECKING:
    from service.settings import Settings

Result = TypeVar("Result")

CONNECT_SECONDS, ANSWER_SECONDS = 5.0, 120.0
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 8.0
PAGE = 500
PROBLEM = "application/problem+json"
OVERLOADED = frozenset({429, 502, 503, 504})

Url = Annotated[
    str | None,
    typer.Option(
        "--url",
        envvar="PLACEREC_URL",
        help="URL of the service. Without it the command opens the data directory itself, unless a service uses it.",
    ),
]
DataDir = Annotated[
    Path | None,
    typer.Option("--data-dir", help="Data directory to open if no URL is given; default: PLACEREC_DATA_DIR."),
]
MapId = Annotated[str, typer.Argument(metavar="MAP", help="The map's id.", show_default=False)]
AsJson = Annotated[bool, typer.Option("--json", help="Write JSON instead of a table.")]


class Refused(Failure):
    """The service answered with a problem.

    Args:
        status: HTTP status.
        slug: the last part of the problem's type, such as ``unknown-map``; "" if the answer is no problem object.
        detail: a sentence.
    """

    def __init__(self, status: int, slug: str, detail: str) -> None:
        super().__init__(detail)
        self.status, self.slug = status, slug


@dataclass
class Target:
    """Where the requests of a command go: a URL, or the data directory if there is none."""

    url: str | None
    data_dir: Path | None


class Service:
    """Requests to one service."""

    def __init__(self, client: httpx.AsyncClient, name: str) -> None:
        self._client, self._name = client, name

    async def request(
        self,
        method: str,
        path: str,
        *,
        patience: float = 0.0,
        final: frozenset[str] = frozenset(),
        headers: dict[str, str] | None = None,
        **options: Any,
    ) -> httpx.Response:
        """Send a request and return its successful answer.

        Args:
            path: the path at the service, such as ``/v1/maps``.
            patience: seconds for which the request is repeated, with the same id, while the service is overloaded,
                starting, or unreachable.
            final: problems after which it is not repeated, by the last part of their type.
            options: as for ``httpx.AsyncClient.request``.

        Raises:
            Refused: the service answers with an error.
            Failure: the service does not answer.
        """
        until = time.monotonic() + patience
        pause = FIRST_PAUSE
        sent = {"X-Request-Id": uuid.uuid4().hex, **(headers or {})}
        while True:
            wait = pause
            try:
                response = await self._client.request(method, path, headers=sent, **options)
            except httpx.InvalidURL as error:
                raise Failure(f"{self._name} is not a URL: {error}.") from error
            except httpx.TimeoutException as error:
                failure: Failure = Failure(f"{self._name} did not answer in time.")
                failure.__cause__ = error
            except httpx.TransportError as error:
                failure = Failure(f"{self._name} cannot be reached: {error or type(error).__name__}.")
                failure.__cause__ = error
            else:
                if response.is_success:
                    return response
                failure = refused = refusal(response)
                wait = retry_after(response, pause)
                if not is_passing(response) or refused.slug in final:
                    raise failure
            if time.monotonic() + wait > until:
                raise failure
            await asyncio.sleep(wait)
            pause = min(2 * pause, LONGEST_PAUSE)

    async def get(self, path: str, **options: Any) -> Any:
        """GET the JSON at ``path``; it raises what ``request`` raises."""
        return (await self.request("GET", path, **options)).json()

    async def pages(self, path: str, params: dict[str, Any] | None = None) -> AsyncIterator[dict[str, Any]]:
        """The pages of a listing in order; it raises what ``request`` raises."""
        cursor: str | None = None
        while True:
            more = {} if cursor is None else {"cursor": cursor}
            page = await self.get(path, params={"limit": PAGE, **(params or {}), **more})
            yield page
            cursor = page["next_cursor"]
            if cursor is None:
                return


def refusal(response: httpx.Response) -> Refused:
    """The error for an unsuccessful answer."""
    if response.headers.get("content-type", "").startswith(PROBLEM):
        problem = response.json()
        slug = problem["type"].rpartition(":")[2]
        hint = f" Set {VARIABLE} to a key of this service." if slug == "key-needed" else ""
        return Refused(response.status_code, slug, problem["detail"] + hint)
    return Refused(
        response.status_code, "", f"{response.url} answered {response.status_code}. Is it a placerec service?"
    )


def is_passing(response: httpx.Response) -> bool:
    """Whether the same request may succeed in a moment.

    A 503 of the service without ``Retry-After`` does not pass by itself: an operator has to act.
    """
    ours = response.headers.get("content-type", "").startswith(PROBLEM)
    return response.status_code in OVERLOADED and ("retry-after" in response.headers or not ours)


def retry_after(response: httpx.Response, otherwise: float) -> float:
    """Seconds to wait: what Retry-After says, or ``otherwise``."""
    asked = response.headers.get("retry-after", "")
    return float(asked) if asked.isdecimal() else otherwise


def path_of(*parts: str) -> str:
    """The path ``/v1/…`` with these parts, which are quoted."""
    return "/v1/" + "/".join(quote(part, safe="") for part in parts)


def media_type(data: bytes) -> str:
    """The content type of a frame by its first bytes; image/jpeg if unknown, which the service then checks."""
    if data.startswith(b"\x89PNG"):
        return "image/png"
    return "image/webp" if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else "image/jpeg"


def read_bytes(path: Path) -> bytes:
    """The bytes of a file.

    Raises:
        Failure: the file cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise Failure(f"{path} cannot be read: {error.strerror}.") from error


@asynccontextmanager
async def open_service(target: Target) -> AsyncIterator[Service]:
    """The service at the target's URL, or one in this process.

    Raises:
        Failure: the URL or a setting is wrong, or another process uses the data directory.
    """
    timeout = httpx.Timeout(ANSWER_SECONDS, connect=CONNECT_SECONDS)
    if target.url is not None:
        if not target.url.startswith(("http://", "https://")):
            raise Failure(f"{target.url} is not a URL of a service: it has to start with http:// or https://.")
        key = given_key()
        if key is not None and is_unencrypted(target.url):
            remark(f"Warning: the key is sent to {target.url} without encryption. Use https.")
        async with httpx.AsyncClient(base_url=target.url, timeout=timeout, headers=headers_for(key)) as client:
            yield Service(client, target.url)
        return
    # Imported here because it takes a second: torch, FAISS and the service itself.
    from service.app.application import create_app

    # Nobody else can reach it, so its address does not matter; its warnings would only repeat its answers.
    settings = read_settings(target.data_dir).model_copy(update={"host": "127.0.0.1", "log_level": "error"})
    application = create_app(settings, as_owner=True)
    async with AsyncExitStack() as stack:
        try:
            await stack.enter_async_context(application.router.lifespan_context(application))
        except DataDirectoryLocked as error:
            raise Failure(f"{error} Give --url to use the service that holds it.") from error
        transport = httpx.ASGITransport(application)
        client = httpx.AsyncClient(base_url="http://placerec", transport=transport, timeout=timeout)
        yield Service(await stack.enter_async_context(client), "The service in this process")


def read_settings(data_dir: Path | None = None) -> Settings:
    """The service's settings, with another data directory if one is given.

    Raises:
        Failure: the environment sets one of them to an invalid value.
    """
    from service import settings

    try:
        found = settings.read_settings()
    except settings.SettingsError as error:
        raise Failure(str(error)) from error
    return found if data_dir is None else found.model_copy(update={"data_dir": data_dir})


def ask(target: Target, method: str, path: str, **options: Any) -> httpx.Response:
    """Send one request and return its answer; it raises what ``Service.request`` raises."""

    async def work() -> httpx.Response:
        async with open_service(target) as service:
            return await service.request(method, path, **options)

    return run(work())


def list_items(target: Target, path: str, params: dict[str, Any] | None = None) -> list[Any]:
    """All items of a listing; it raises what ``Service.request`` raises."""

    async def work() -> list[Any]:
        async with open_service(target) as service:
            return [item async for page in service.pages(path, params) for item in page["items"]]

    return run(work())


def run(work: Coroutine[Any, Any, Result]) -> Result:
    """Run the asynchronous work of a command."""
    return asyncio.run(work)
