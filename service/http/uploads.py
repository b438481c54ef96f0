"""Frames as they are sent: the raw body, or the parts of a form."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from starlette.requests import Request

from core.errors import EmptyImage, ImageTooLarge
from core.frames.containers import read_header
from service.errors.faults import InvalidRequest, UnsupportedMediaType
from service.http.bodies import intake_of, parse_json
from service.http.multipart import Part, read_form
from service.settings import Settings

FORMATS = {"image/jpeg": "jpeg", "image/png": "png", "image/webp": "webp"}
UNTOLD = (None, "application/octet-stream")
"""What a form's part may say that knows no better; the bytes decide."""

FORM = "multipart/form-data"
FORM_ALLOWANCE = 256 * 1024
"""Bytes that a form may have besides its frames: boundaries, headers, fields."""

FIELD_PARTS = 16


@dataclass(frozen=True)
class Frame:
    """One picture as it was sent, not decoded yet, and the form fields beside it."""

    data: bytes
    fields: Mapping[str, str]


def media_type(request: Request) -> str:
    """The request's content type without its parameters, in lower case; "" if it names none."""
    return request.headers.get("content-type", "").split(";")[0].strip().lower()


def check_frame(data: bytes, content_type: str | None) -> None:
    """See from the first bytes whether they can be a frame, of the type that was announced.

    Bytes of another format than the content type says are refused even when they could be decoded:
    the sender is wrong about what it sends, and had better know.

    Raises:
        InvalidImage: no bytes, or not those of a JPEG, PNG or WebP file.
        UnsupportedMediaType: the content type is of no such file, or of another one.
    """
    if content_type not in UNTOLD and content_type not in FORMATS:
        raise UnsupportedMediaType(f"A frame is sent as {', '.join(FORMATS)}, not as {str(content_type)[:80]}.")
    if not data:
        raise EmptyImage("The frame has no bytes.")
    found = read_header(data).format
    if content_type not in UNTOLD and FORMATS[content_type] != found:
        raise UnsupportedMediaType(f"The frame is sent as {content_type}, but its bytes are those of a {found} file.")


def check_part(part: Part, settings: Settings) -> None:
    """The same for a part of a form.

    Raises:
        ImageTooLarge: it has too many bytes.
        InvalidImage, UnsupportedMediaType: as for ``check_frame``.
    """
    if part.oversized:
        raise ImageTooLarge(f"The frame has more than {settings.max_image_bytes} bytes.")
    check_frame(part.data, part.content_type)


async def read_frame(request: Request, settings: Settings) -> Frame:
    """One frame: the raw body, or the one file part of a form, whose other parts are its fields.

    Raises:
        UnsupportedMediaType: the request is neither.
        BodyTooLarge, MalformedBody: the body breaks a limit or its own form.
        InvalidRequest: a form without just one file part, or with a field given twice.
        InvalidImage: the bytes are not those of a frame.
    """
    kind = media_type(request)
    if kind == FORM:
        files, fields = split_form(await _read_parts(request, settings, 1))
        if len(files) != 1:
            raise InvalidRequest(f"The form has {len(files)} file parts; send one frame.")
        check_part(files[0], settings)
        return Frame(files[0].data, fields)
    if kind not in FORMATS:
        named = kind[:80] or "anything unnamed"
        raise UnsupportedMediaType(f"A frame is sent as {', '.join(FORMATS)} or in a {FORM}, not as {named}.")
    intake_of(request).limit = settings.max_image_bytes
    data = await request.body()
    check_frame(data, kind)
    return Frame(data, {})


async def read_pair(request: Request, settings: Settings) -> tuple[bytes, bytes, Mapping[str, str]]:
    """The frames in the parts ``a`` and ``b`` of a form, and its fields; errors as for ``read_frame``."""
    files, fields = split_form(await _read_form(request, settings, 2))
    found = {part.name: part for part in files}
    if len(files) != 2 or set(found) != {"a", "b"}:
        raise InvalidRequest("The form needs two file parts, named a and b.")
    for part in files:
        check_part(part, settings)
    return found["a"].data, found["b"].data, fields


async def read_many(request: Request, settings: Settings) -> list[Part]:
    """The parts of a form of many frames, unchecked: one that is bad shall fail alone.

    Raises:
        UnsupportedMediaType: not a form.
        BodyTooLarge, MalformedBody: the body breaks a limit or its own form.
    """
    return await _read_form(request, settings, settings.max_batch_items)


async def _read_form(request: Request, settings: Settings, frames: int) -> list[Part]:
    kind = media_type(request)
    if kind != FORM:
        raise UnsupportedMediaType(f"The frames are sent in a {FORM}, not as {kind[:80] or 'anything unnamed'}.")
    return await _read_parts(request, settings, frames)


async def _read_parts(request: Request, settings: Settings, frames: int) -> list[Part]:
    intake_of(request).limit = min(frames * settings.max_image_bytes, settings.max_batch_bytes) + FORM_ALLOWANCE
    content_type = request.headers["content-type"]
    return await read_form(request.stream(), content_type, frames + FIELD_PARTS, settings.max_image_bytes)


def is_file(part: Part) -> bool:
    """Whether a part is a frame rather than a field: it has a file name, or says it is neither text nor JSON."""
    if part.filename is not None or part.content_type is None:
        return part.filename is not None
    return not part.content_type.startswith("text/") and part.content_type != "application/json"


def split_form(parts: Iterable[Part]) -> tuple[list[Part], dict[str, str]]:
    """File parts, and fields by name.

    Raises:
        InvalidRequest: a field stands twice, is too large, or is not UTF-8.
    """
    files: list[Part] = []
    fields: dict[str, str] = {}
    for part in parts:
        if is_file(part):
            files.append(part)
        elif part.name in fields:
            raise InvalidRequest(f"The field {part.name[:80]!r} stands in the form twice.")
        elif part.oversized or len(part.data) > FORM_ALLOWANCE:
            raise InvalidRequest(f"The field {part.name[:80]!r} is too large.")
        else:
            fields[part.name] = _text(part)
    return files, fields


def _text(part: Part) -> str:
    try:
        return part.data.decode()
    except UnicodeDecodeError:
        raise InvalidRequest(f"The field {part.name[:80]!r} is not UTF-8.") from None


def json_part(parts: Iterable[Part], name: str) -> tuple[Any, list[Part]]:
    """The value of the one JSON part ``name``, and the other parts.

    Raises:
        InvalidRequest: there is none, or more than one.
        MalformedBody: it is not JSON.
    """
    chosen = [part for part in parts if part.name == name]
    if len(chosen) != 1 or chosen[0].oversized:
        raise InvalidRequest(f"The form needs one JSON part named {name!r}.")
    return parse_json(chosen[0].data, f"The part {name!r}"), [part for part in parts if part.name != name]


def parse_metadata(text: str) -> dict[str, Any]:
    """Metadata given as JSON text in a parameter.

    Raises:
        InvalidRequest: it is not a JSON object.
    """
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        raise InvalidRequest("metadata: it is not JSON.") from None
    if not isinstance(value, dict):
        raise InvalidRequest("metadata: it is not a JSON object.")
    return value
