"""The client of the commands, which talks to a service at a URL or runs the application in this process.

Without a URL the application runs here, without a socket, under the exclusive lock of the data directory; the requests
take the same routes either way.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import httpx
import typer

from core.errors import DataDirectoryLocked
from placerec_client import AsyncClient, PlacerecError, Problem, Retry, UnexpectedAnswer, requests
from placerec_client.frames import media_type
from placerec_client.requests import Part, form
from service.commands.connection.credentials import VARIABLE, given_key, is_unencrypted
from service.commands.console import Failure, remark
from service.commands.options.settings import read_settings

if TYPE_CHECKING:
    pass

Result = TypeVar("Result")

ANSWER_SECONDS = 120.0
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 8.0
PAGE = 500

Url = Annotated[
    str | None,
    typer.Option(
        "--url",
        envvar="PLACEREC_URL",
        help="URL of the service. Without it the command opens the data directory itself, which no service may hold.",
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
class CommandTarget:
    """Where the requests of a command go: a URL, or the data directory if there is none."""

    url: str | None
    data_dir: Path | None


class Service:
    """Requests to one service, through its client.

    Args:
        client: which sends each request once; ``client`` of the object.
    """

    def __init__(self, client: AsyncClient) -> None:
        self.client = client

    def patient(self, seconds: float) -> AsyncClient:
        """The client that repeats requests for this time in seconds while the service is overloaded."""
        return self.client.patient(Retry(seconds, FIRST_PAUSE, LONGEST_PAUSE))

    async def request(
        self,
        method: str,
        path: str,
        *,
        patience: float = 0.0,
        files: Sequence[tuple[str, tuple[str | None, bytes | str, str]]] | None = None,
        headers: Mapping[str, str] | None = None,
        **options: Any,
    ) -> httpx.Response:
        """Send a request and return its successful answer, as the service gave it: commands show it to the last field.

        Args:
            path: the path at the service, such as ``/v1/maps``.
            patience: seconds for which the request is repeated, with the same id, while the service is overloaded,
                starting, or unreachable.
            files: the parts of a form: name, file name, data, content type.
            headers: besides those of every request.
            options: as for the client's ``connection.request``.

        Raises:
            Refused: the service answers with an error.
            Failure: the service does not answer.
        """
        if files is not None:
            options["content"], options["media_type"] = form([_part(*one) for one in files])
        with failures():
            connection = self.patient(patience).connection
            return await connection.request(method, path, headers=headers, **options)

    async def get(self, path: str, **options: Any) -> Any:
        """GET the JSON at ``path``; it raises what ``request`` raises."""
        return (await self.request("GET", path, **options)).json()

    async def pages(self, path: str, params: dict[str, Any] | None = None) -> AsyncIterator[dict[str, Any]]:
        """The pages of a listing in order; it raises what ``request`` raises."""
        cursor: str | None = None
        while True:
            page = await self.get(path, params={"limit": PAGE, **(params or {}), "cursor": cursor})
            yield page
            cursor = page["next_cursor"]
            if cursor is None:
                return


def _part(name: str, content: tuple[str | None, bytes | str, str]) -> Part:
    filename, data, kind = content
    return Part(name, data.encode() if isinstance(data, str) else data, kind, is_file=filename is not None)


@contextmanager
def failures() -> Iterator[None]:
    """Turn the client's errors into those of the commands.

    Raises:
        Refused: the service answered with an error.
        Failure: it did not answer.
    """
    try:
        yield
    except Problem as problem:
        hint = f" Set {VARIABLE} to a key of this service." if problem.slug == "key-needed" else ""
        raise Refused(problem.status, problem.slug, problem.detail + hint) from problem
    except UnexpectedAnswer as error:
        raise Refused(error.status, "", str(error)) from error
    except PlacerecError as error:
        raise Failure(str(error)) from error


def path_of(*segments: str) -> str:
    """The path ``/v1/…`` of these segments, which the client quotes.

    Raises:
        Failure: a segment is nothing that can be named.
    """
    with failures():
        return requests.path_of(*segments)


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
async def open_service(target: CommandTarget) -> AsyncIterator[Service]:
    """The service at the target's URL, or one in this process.

    Raises:
        Failure: the URL or a setting is wrong, or another process uses the data directory.
    """
    if target.url is not None:
        key = given_key()
        with failures():
            made = AsyncClient(target.url, key=key, timeout=ANSWER_SECONDS, retry=Retry(0))
        if key is not None and is_unencrypted(made.connection.url):
            remark(f"Warning: the key is sent to {made.connection.url} without encryption. Use https.")
        async with made as client:
            yield Service(client)
        return
    # Imported here because it takes a second: torch, FAISS and the service itself.
    from service.app.application import create_app

    # Nobody else can reach it, so its address does not matter; its warnings would only repeat its answers.
    settings = read_settings(target.data_dir).model_copy(update={"host": "127.0.0.1", "log_level": "error"})
    application = create_app(settings.model_copy(update={"rehearsal": False}), as_owner=True)
    async with AsyncExitStack() as stack:
        try:
            await stack.enter_async_context(application.router.lifespan_context(application))
        except DataDirectoryLocked as error:
            raise Failure(str(error)) from error
        client = AsyncClient(
            "http://placerec",
            timeout=ANSWER_SECONDS,
            retry=Retry(0),
            transport=httpx.ASGITransport(application),
            name="The service in this process",
        )
        yield Service(await stack.enter_async_context(client))


def ask(target: CommandTarget, method: str, path: str, **options: Any) -> httpx.Response:
    """Send one request and return its answer; it raises what ``Service.request`` raises."""

    async def work() -> httpx.Response:
        async with open_service(target) as service:
            return await service.request(method, path, **options)

    return run(work())


def list_items(target: CommandTarget, path: str, params: dict[str, Any] | None = None) -> list[Any]:
    """All items of a listing; it raises what ``Service.request`` raises."""

    async def work() -> list[Any]:
        async with open_service(target) as service:
            return [item async for page in service.pages(path, params) for item in page["items"]]

    return run(work())


def run(work: Coroutine[Any, Any, Result]) -> Result:
    """Run the asynchronous work of a command."""
    return asyncio.run(work)


__all__ = [
    "AsJson",
    "CommandTarget",
    "DataDir",
    "MapId",
    "Refused",
    "Service",
    "Url",
    "ask",
    "failures",
    "list_items",
    "media_type",
    "open_service",
    "path_of",
    "read_bytes",
    "run",
]
