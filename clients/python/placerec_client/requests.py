"""The parts of requests: paths, query strings, JSON, forms."""

from __future__ import annotations

import json
import math
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Any, TypeVar
from urllib.parse import quote, urlencode

from placerec_client.errors import InvalidName, InvalidParameter

Item = TypeVar("Item")

TIMES = frozenset({"timestamp", "after", "before", "since", "until", "at", "measured_at", "expires_at"})
"""Names under which a number is a time, in seconds since 1970 by UTC, as ``time.time()`` has it."""
FIRST_TIME, LAST_TIME = 946_684_800, 4_102_444_800
"""2000 and 2100: a number before is no such time but one since the start of a machine; one after is in other units."""
OF_THE_CALLER = frozenset({"metadata", "where"})
"""Objects whose names are the caller's own."""

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
    value = as_meant(name, value)
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


def as_meant(name: str, value: Any) -> Any:
    """A value as the service takes it: a time in seconds as a datetime, a heading in [0, 360); also within a body.

    Raises:
        InvalidParameter: a number cannot be a time.
    """
    if isinstance(value, Mapping):
        return value if name in OF_THE_CALLER else {key: as_meant(key, one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_meant(name, one) for one in value]
    number = number_of(value) if name in TIMES or name == "heading" else None
    if number is None:
        return value
    return wrapped(number) if name == "heading" else time_of(name, number)


def time_of(name: str, seconds: float) -> datetime:
    """The time so many seconds after 1970 began, by UTC.

    Raises:
        InvalidParameter: that is before 2000 or after 2100, so it was meant otherwise.
    """
    if FIRST_TIME <= seconds <= LAST_TIME:
        return datetime.fromtimestamp(seconds, UTC)
    why = "it has to be seconds since 1970, as time.time() has them, or a datetime"
    if seconds < FIRST_TIME:
        why += "; a clock that counts from the start of a machine, such as time.monotonic(), tells no time"
    for unit, share in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        if FIRST_TIME <= seconds / share <= LAST_TIME:
            why += f"; these seem to be {unit}: divide by {share:.0e}".replace("e+0", "e")
    raise InvalidParameter(f"{name} cannot be {seconds!r}: {why}.")


def wrapped(degrees: float) -> float:
    """An angle in [0, 360); one that is not finite stays, and the service refuses it."""
    if not math.isfinite(degrees):
        return degrees
    turned = degrees % 360
    return 0.0 if turned == 360 else turned  # of a tiny one below zero the remainder is rounded up


def number_of(value: Any) -> float | None:
    """A number of Python or NumPy; None if it is none."""
    if isinstance(value, (bool, str, *BYTES)) or getattr(value, "ndim", 0) != 0:
        return None
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return None


def items_of(name: str, given: Iterable[Item]) -> Iterable[Item]:
    """Return several things as they were given.

    Raises:
        InvalidParameter: it is no iterable, or a text or bytes.
    """
    if isinstance(given, (str, *BYTES)) or not isinstance(given, Iterable):
        raise InvalidParameter(f"{name} has to be a list or another iterable, not a {type(given).__name__}.")
    return given


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
        return json.dumps(as_meant(name, value), default=_plain)
    except InvalidParameter:
        raise
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
