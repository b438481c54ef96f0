"""What is sent: paths, query strings, JSON, forms."""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any
from urllib.parse import quote, urlencode

from placerec_client.errors import InvalidName


def path_of(*segments: str | int, below: str = "/v1") -> str:
    """The path of these segments, which are quoted, below another path; every path with a name in it is made here.

    Whatever has to do with a URL on its way (httpx, a proxy, a browser) takes out a segment ``.``, and ``..`` together
    with the one before it: the path would be that of something else. No name has a slash, which many unquote.

    Raises:
        InvalidName: a segment is one of these, or empty.
    """
    texts = [str(one) if isinstance(one, int) else one for one in segments]
    for text in texts:
        if text in ("", ".", "..") or "/" in text:
            raise InvalidName(text)
    return "/".join([below, *(quote(text, safe="") for text in texts)])


def query_string(parameters: Mapping[str, Any]) -> str:
    """The query string with its question mark; parameters that are None are left out."""
    given = [(name, text_of(name, value)) for name, value in parameters.items() if value is not None]
    return "?" + urlencode(given) if given else ""


def text_of(name: str, value: Any) -> str:
    """One parameter as text: numbers in full, times in ISO 8601, lists with commas, objects as JSON."""
    if isinstance(value, str):
        return value
    if getattr(value, "ndim", None) == 0:  # a number of NumPy, whose text is not the number's
        value = value.item()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, date):  # or a datetime
        return value.isoformat()
    if isinstance(value, Mapping):
        return dumps(value)
    if isinstance(value, Iterable):
        texts = [one if isinstance(one, str) else repr(float(one)) for one in value]
        return dumps(texts) if name == "sequences" and any("," in one for one in texts) else ",".join(texts)
    return repr(value) if isinstance(value, float) else str(value)


def dumps(value: Any) -> str:
    """A value as JSON: times become ISO 8601, and ``with_`` and ``from_`` lose their underscore."""
    return json.dumps(value, default=_plain)


def fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments as the fields of a body: names that Python reserves are written with an underscore."""
    return {name.removesuffix("_"): value for name, value in given.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Iterable):
        return list(value)
    return value.item()  # a number of NumPy


@dataclass(frozen=True)
class Part:
    """A part of a form: a frame, or JSON without a file name."""

    name: str
    data: bytes
    media_type: str
    is_file: bool = True


def form(parts: Sequence[Part]) -> tuple[bytes, str]:
    """The body of a form, and its content type."""
    boundary = secrets.token_hex(16)
    chunks: list[bytes] = []
    for part in parts:
        chunks += [part_head(part, boundary), part.data, b"\r\n"]
    return b"".join([*chunks, part_end(boundary)]), form_type(boundary)


def part_head(part: Part, boundary: str) -> bytes:
    """What comes before the data of one part."""
    name = part.name.replace("\\", "\\\\").replace('"', "%22").replace("\r", "%0D").replace("\n", "%0A")
    file = f'; filename="{name}"' if part.is_file else ""
    return (
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"{file}\r\n'
        f"Content-Type: {part.media_type}\r\n\r\n"
    ).encode()


def part_end(boundary: str) -> bytes:
    """What comes after the last part and its line end."""
    return f"--{boundary}--\r\n".encode()


def form_type(boundary: str) -> str:
    """The content type of a form."""
    return f"multipart/form-data; boundary={boundary}"
