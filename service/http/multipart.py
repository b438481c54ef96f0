"""A parser of multipart/form-data that reads a form as it arrives, with limits on its parts and on their number."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from core.names import composed
from service.errors.faults import BodyTooLarge, MalformedBody

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks


@dataclass
class FormPart:
    """One part of a form.  ``data`` is empty if the part was ``oversized``, because its bytes were not retained."""

    name: str = ""
    filename: str | None = None
    content_type: str | None = None
    data: bytes = b""
    oversized: bool = False


@dataclass
class _OpenPart:
    headers: dict[bytes, bytes] = field(default_factory=dict)
    chunks: list[bytes] = field(default_factory=list)
    size: int = 0


class FormReader:
    """Parses the chunks of a form into parts.

    Args:
        content_type: the value of the request's Content-Type header.
        max_parts: most parts of the form.
        max_part_bytes: most bytes of one part.

    Raises:
        MalformedBody: the header gives no boundary, or one that cannot be used.
    """

    def __init__(self, content_type: str, max_parts: int, max_part_bytes: int) -> None:
        _, options = parse_options_header(content_type)
        boundary = options.get(b"boundary")
        if not boundary:
            raise MalformedBody("The Content-Type gives no multipart boundary.")
        self.parts: list[FormPart] = []
        self._max_parts, self._max_part_bytes = max_parts, max_part_bytes
        self._part = _OpenPart()
        self._field, self._value = b"", b""
        self._ended = False
        callbacks: MultipartCallbacks = {
            "on_part_begin": self._begin,
            "on_header_field": self._add_to_field,
            "on_header_value": self._add_to_value,
            "on_header_end": self._end_header,
            "on_part_data": self._add_data,
            "on_part_end": self._end_part,
            "on_end": self._end,
        }
        try:
            self._parser = MultipartParser(boundary, callbacks)
        except FormParserError as error:
            raise MalformedBody(f"The multipart boundary cannot be used: {error}") from error

    def feed(self, chunk: bytes) -> None:
        """Parse the next bytes.

        Raises:
            MalformedBody: the bytes are not those of a multipart form.
            BodyTooLarge: there are more parts than the limit.
        """
        try:
            self._parser.write(chunk)
        except FormParserError as error:
            raise MalformedBody(f"The body is not a valid multipart form: {error}.") from error

    def close(self) -> list[FormPart]:
        """All parts; call it after the last chunk.

        Raises:
            MalformedBody: the closing boundary is missing, so the form was cut short.
        """
        if not self._ended:
            raise MalformedBody("The multipart form ends before its closing boundary.")
        return self.parts

    def _begin(self) -> None:
        if len(self.parts) >= self._max_parts:
            raise BodyTooLarge(f"The form has more than {self._max_parts} parts.")
        self._part = _OpenPart()

    def _add_to_field(self, data: bytes, start: int, end: int) -> None:
        self._field += data[start:end]

    def _add_to_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _end_header(self) -> None:
        self._part.headers[self._field.lower()] = self._value
        self._field, self._value = b"", b""

    def _add_data(self, data: bytes, start: int, end: int) -> None:
        part = self._part
        part.size += end - start
        if part.size <= self._max_part_bytes:
            part.chunks.append(data[start:end])
        else:
            part.chunks.clear()

    def _end_part(self) -> None:
        headers = self._part.headers
        _, options = parse_options_header(headers.get(b"content-disposition", b""))
        try:
            name = composed(options.get(b"name", b"").decode())
            filename = composed(options[b"filename"].decode()) if b"filename" in options else None
            content_type = headers.get(b"content-type", b"").split(b";")[0].strip().lower().decode() or None
        except UnicodeDecodeError as error:
            raise MalformedBody("A part's headers are not UTF-8.") from error
        if not name:
            raise MalformedBody("A part of the form has no name.")
        oversized = self._part.size > self._max_part_bytes
        self.parts.append(FormPart(name, filename, content_type, b"".join(self._part.chunks), oversized))

    def _end(self) -> None:
        self._ended = True


async def read_form(
    chunks: AsyncIterator[bytes], content_type: str, max_parts: int, max_part_bytes: int
) -> list[FormPart]:
    """Read all parts of a form, in order.

    Raises:
        MalformedBody: the body is not a valid form, or was cut short.
        BodyTooLarge: the form has too many parts.
    """
    reader = FormReader(content_type, max_parts, max_part_bytes)
    async for chunk in chunks:
        reader.feed(chunk)
    return reader.close()
