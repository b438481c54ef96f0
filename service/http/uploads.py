"""Frames as they are sent: the raw body, or the parts of a form."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from starlette.requests import Request

from core.errors import EmptyImage, ImageTooLarge
from core.frames.containers import read_header
from core.names import composed
from service.errors.faults import InvalidRequest, UnsupportedMediaType
from service.http.bodies import intake_of, parse_json, read_json
from service.http.multipart import FormPart, read_form
from service.settings import Settings

FORMATS = {"image/jpeg": "jpeg", "image/png": "png", "image/webp": "webp"}
OTHER_NAMES = {"image/jpg": "image/jpeg", "image/pjpeg": "image/jpeg", "image/x-png": "image/png"}
"""Content types of the same formats that some clients send."""

UNSPECIFIC = (None, "application/octet-stream")
"""Content types of a part that do not say which format it has; its first bytes decide."""

FORM = "multipart/form-data"
FORM_ALLOWANCE = 256 * 1024
"""Bytes that a form may have besides its frames: boundaries, headers, fields."""

FIELD_PARTS = 16
"""Parts that a form may have besides its frames."""


@dataclass(frozen=True)
class UploadedFrame:
    """A frame as it was sent, not decoded yet, and the form fields that came with it."""

    data: bytes
    fields: Mapping[str, str]


def media_type(request: Request) -> str:
    """The request's content type by its registered name, without parameters, in lower case; "" if it names none."""
    kind = request.headers.get("content-type", "").split(";")[0].strip().lower()
    return OTHER_NAMES.get(kind, kind)


def check_frame(data: bytes, content_type: str | None) -> None:
    """Check from the first bytes that data can be a frame, and that it has the format of its content type.

    Another format than the content type says is refused even if it could be decoded, because the sender is wrong
    about what it sends.

    Raises:
        InvalidImage: there are no bytes, or they are not those of a JPEG, PNG or WebP file.
        UnsupportedMediaType: the content type is of no such file, or of another format.
    """
    content_type = OTHER_NAMES.get(content_type or "", content_type)
    if content_type not in UNSPECIFIC and content_type not in FORMATS:
        raise UnsupportedMediaType(f"Send a frame as {', '.join(FORMATS)}, not as {str(content_type)[:80]}.")
    if not data:
        raise EmptyImage("The frame has no bytes.")
    found = read_header(data).format
    if content_type not in UNSPECIFIC and FORMATS[content_type] != found:
        raise UnsupportedMediaType(f"The content type is {content_type}, but the bytes are those of a {found} file.")


def check_part(part: FormPart, settings: Settings) -> None:
    """Check a part of a form as :func:`check_frame` does.

    Raises:
        ImageTooLarge: the part has too many bytes.
        InvalidImage, UnsupportedMediaType: as for ``check_frame``.
    """
    if part.oversized:
        raise ImageTooLarge(f"The frame has more than {settings.max_image_bytes} bytes.")
    check_frame(part.data, part.content_type)


async def read_frame(request: Request, settings: Settings) -> UploadedFrame:
    """Read one frame: the raw body, or the one file part of a form, whose other parts are its fields.

    Raises:
        UnsupportedMediaType: the content type is neither of a frame nor of a form.
        BodyTooLarge, MalformedBody: the body breaks a limit, or is not a valid form.
        InvalidRequest: the form does not have exactly one file part, or a field is given twice.
        InvalidImage: the bytes are not those of a frame.
    """
    kind = media_type(request)
    if kind == FORM:
        files, fields = split_form(await _read_parts(request, settings, 1))
        if len(files) != 1:
            raise InvalidRequest(f"The form has {len(files)} file parts. Send exactly one frame.")
        check_part(files[0], settings)
        return UploadedFrame(files[0].data, fields)
    if kind not in FORMATS:
        raise UnsupportedMediaType(f"Send a frame as {', '.join(FORMATS)} or in a {FORM} body{instead_of(kind)}.")
    intake_of(request).limit = settings.max_image_bytes
    data = await request.body()
    check_frame(data, kind)
    return UploadedFrame(data, {})


async def read_pair(request: Request, settings: Settings) -> tuple[bytes, bytes, Mapping[str, str]]:
    """Read the frames in the parts ``a`` and ``b`` of a form, and its fields; errors are those of ``read_frame``."""
    files, fields = split_form(await _read_form(request, settings, 2))
    found = {part.name: part for part in files}
    if len(files) != 2 or set(found) != {"a", "b"}:
        raise InvalidRequest("The form needs exactly two file parts, named a and b.")
    for part in files:
        check_part(part, settings)
    return found["a"].data, found["b"].data, fields


async def read_many(request: Request, settings: Settings) -> list[FormPart]:
    """Read the parts of a form of many frames.  They are not checked here, so that a bad one fails alone.

    Raises:
        UnsupportedMediaType: the body is not a form.
        BodyTooLarge, MalformedBody: the body breaks a limit, or is not a valid form.
        InvalidRequest: it has more frames than a batch may have, though not more parts than these and some fields.
    """
    parts = await _read_form(request, settings, settings.max_batch_items)
    if (count := sum(map(is_file, parts))) > settings.max_batch_items:
        raise InvalidRequest(f"The form has {count} file parts; the limit is {settings.max_batch_items}.")
    return parts


async def _read_form(request: Request, settings: Settings, frames: int) -> list[FormPart]:
    kind = media_type(request)
    if kind != FORM:
        raise UnsupportedMediaType(f"Send the frames in a {FORM} body{instead_of(kind)}.")
    return await _read_parts(request, settings, frames)


def instead_of(kind: str) -> str:
    """The end of a sentence about the wanted content type: the one that the request has instead."""
    return f", not as {kind[:80]}" if kind else "; the request has no Content-Type"


async def _read_parts(request: Request, settings: Settings, frames: int) -> list[FormPart]:
    intake_of(request).limit = min(frames * settings.max_image_bytes, settings.max_batch_bytes) + FORM_ALLOWANCE
    content_type = request.headers["content-type"]
    return await read_form(request.stream(), content_type, frames + FIELD_PARTS, settings.max_image_bytes)


def is_file(part: FormPart) -> bool:
    """Whether a part is a file rather than a field: it has a file name, or a content type other than text and JSON."""
    if part.filename is not None or part.content_type is None:
        return part.filename is not None
    return not part.content_type.startswith("text/") and part.content_type != "application/json"


def split_form(parts: Iterable[FormPart]) -> tuple[list[FormPart], dict[str, str]]:
    """Split a form into its file parts and its fields by name.

    Raises:
        InvalidRequest: a field is given twice, is too large, or is not UTF-8.
    """
    files: list[FormPart] = []
    fields: dict[str, str] = {}
    for part in parts:
        if is_file(part):
            files.append(part)
        elif part.name in fields:
            raise InvalidRequest(f"The form has the field {part.name[:80]!r} twice.")
        elif part.oversized or len(part.data) > FORM_ALLOWANCE:
            raise InvalidRequest(f"The field {part.name[:80]!r} is too large.")
        else:
            fields[part.name] = _text(part)
    return files, fields


def _text(part: FormPart) -> str:
    try:
        return composed(part.data.decode())
    except UnicodeDecodeError:
        raise InvalidRequest(f"The field {part.name[:80]!r} is not UTF-8.") from None


def json_part(parts: Iterable[FormPart], name: str) -> tuple[Any, list[FormPart]]:
    """The parsed value of the JSON part ``name``, and the other parts.

    Raises:
        InvalidRequest: there is no such part, or more than one.
        MalformedBody: the part is not JSON.
    """
    chosen = [part for part in parts if part.name == name]
    if len(chosen) != 1 or chosen[0].oversized:
        raise InvalidRequest(f"The form needs exactly one JSON part named {name!r}.")
    return parse_json(chosen[0].data, f"The part {name!r}"), [part for part in parts if part.name != name]


def parse_metadata(text: str) -> dict[str, Any]:
    """Parse metadata that is given as JSON text in a parameter.

    Raises:
        InvalidRequest: the text is not a JSON object.
    """
    try:
        value = read_json(text)
    except (ValueError, RecursionError):
        raise InvalidRequest("metadata: the value is not valid JSON, or has a name twice.") from None
    if not isinstance(value, dict):
        raise InvalidRequest("metadata: the value is not a JSON object.")
    return value
