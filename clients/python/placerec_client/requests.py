"""The parts of requests: paths, query strings, JSON, forms."""

from __future__ import annotations

import json
import math
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any
from urllib.parse import quote, urlencode

from placerec_client.errors import InvalidName, InvalidParameter

BYTES = (bytes, bytearray, memoryview)
"""They are sequences of numbers, but what is meant by them is a text."""


def path_of(*segments: str | int, below: str = "/v1") -> str:
    """The path of these segments, which are quoted, below another path; every path with a name in it is made here.

    Whatever has to do with a URL on its way (httpx, a proxy, a browser) takes out a segment ``.``, and ``..`` together
    with the one before it: the path would be that of something else. No name has a slash, which many unquote.

    Raises:
        InvalidName: a segment is one of these, or empty.
    """
    texts = [str(one) if isinstance(one, int) else name_of(one) for one in segments]
    return "/".join([below, *(quote(text, safe="") for text in texts)])


def name_of(name: object) -> str:
    """Return a name if anything can have it.

    Raises:
        InvalidName: nothing can.
    """
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name:
        raise InvalidName(name)
    if _is_cut(name):
        raise InvalidName(name, "it has half a character")
    return name


def query_string(parameters: Mapping[str, Any]) -> str:
    """The query string with its question mark; parameters that are None are left out."""
    given = [(name, text_of(name, value)) for name, value in parameters.items() if value is not None]
    return "?" + urlencode(given) if given else ""


def text_of(name: str, value: Any) -> str:
    """One parameter as text: numbers in full, times in ISO 8601, lists with commas, objects as JSON.

    Raises:
        InvalidParameter: it is nothing of these.
    """
    if isinstance(value, Mapping):
        return dumps(value, name)
    if not isinstance(value, Iterable) or isinstance(value, (str, *BYTES)) or getattr(value, "ndim", None) == 0:
        return _single(name, value)
    texts = [_single(name, float(one) if type(one) is int else one) for one in value]
    return dumps(texts) if name == "sequences" and any("," in one for one in texts) else ",".join(texts)


def _single(name: str, value: Any) -> str:
    """The text of a value that is no list."""
    if getattr(value, "ndim", None) == 0:  # a number of NumPy, whose text is not the number's
        value = value.item()
    if isinstance(value, str):
        if _is_cut(value):
            raise InvalidParameter(f"{name} has half a character: {value[:140]!a}.")
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, date):  # or a datetime
        return value.isoformat()
    number = number_of(value)
    if number is None:
        raise InvalidParameter(f"{name} cannot be a {type(value).__name__}: give a text or a number, or what it takes.")
    return repr(number)


def number_of(value: Any) -> float | None:
    """A number of Python or NumPy; None if it is none."""
    if isinstance(value, (bool, str, *BYTES)) or getattr(value, "ndim", 0) != 0:
        return None
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return None


def seconds_of(name: str, value: Any) -> float:
    """Return a time limit as it is counted with.

    Raises:
        InvalidParameter: it is no number.
    """
    seconds = number_of(value)
    if seconds is None or math.isnan(seconds):
        raise InvalidParameter(f"{name} has to be a number of seconds, not {ascii(value)[:140]}.")
    return seconds


def dumps(value: Any, name: str = "what is given") -> str:
    """A value as JSON; times become ISO 8601.

    Args:
        name: its name in errors.

    Raises:
        InvalidParameter: it has something that JSON has not.
    """
    try:
        return json.dumps(value, default=_plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise InvalidParameter(f"JSON cannot have {name}: {error}.") from error


def fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments as the fields of a body: names that Python reserves are written with an underscore.

    Raises:
        InvalidParameter: these are none.
    """
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise InvalidParameter(f"Fields have to be given by their names, not as {ascii(given)[:140]}.")
    return {name.removesuffix("_"): value for name, value in given.items()}


def _is_cut(text: str) -> bool:
    """Whether a text has half a character, which UTF-8 has not."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return True
    return False


def _plain(value: Any) -> Any:
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, Mapping):
        return dict(value)
    if hasattr(value, "tolist"):  # of NumPy
        return value.tolist()
    if isinstance(value, Iterable) and not isinstance(value, BYTES):
        return list(value)
    raise TypeError(f"a {type(value).__name__} is no value of it")


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
    """The bytes before the data of one part."""
    name = (
        text_of("the name of a frame", part.name)
        .replace("\\", "\\\\")
        .replace('"', "%22")
        .replace("\r", "%0D")
        .replace("\n", "%0A")
    )
    file = f'; filename="{name}"' if part.is_file else ""
    return (
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"{file}\r\n'
        f"Content-Type: {part.media_type}\r\n\r\n"
    ).encode()


def part_end(boundary: str) -> bytes:
    """The bytes after the last part and its line end."""
    return f"--{boundary}--\r\n".encode()


def form_type(boundary: str) -> str:
    """The content type of a form."""
    return f"multipart/form-data; boundary={boundary}"
