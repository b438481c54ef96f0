"""Digests that a request states of its body (RFC 9530); what does not match them is refused."""

from __future__ import annotations

import base64
import binascii
import hashlib
import re

from service.errors.faults import DigestMismatch, InvalidRequest

ALGORITHMS = {"sha-256": hashlib.sha256, "sha-512": hashlib.sha512}
"""Those that are checked; any other algorithm is ignored."""

_MEMBER = re.compile(r"\s*([a-z*][a-z0-9*_.-]*)\s*=\s*:([A-Za-z0-9+/=]*):\s*(;.*)?")


class StatedDigests:
    """The digests that one body must have."""

    def __init__(self) -> None:
        self._stated: list[tuple[str, str, bytes]] = []
        self._hashes: dict[str, hashlib._Hash] = {}

    def expect(self, header: str, value: str) -> None:
        """Add those of a header, ``Content-Digest`` or ``Repr-Digest``, before the first bytes come.

        Raises:
            InvalidRequest: it has not the form that RFC 9530 gives it.
        """
        for member in filter(str.strip, value.split(",")):
            if (parsed := _MEMBER.fullmatch(member)) is None:
                raise InvalidRequest(f"{header}: it must have the form sha-256=:…:, with the digest in base64.")
            algorithm, text, _ = parsed.groups()
            if algorithm in ALGORITHMS:
                try:
                    digest = base64.b64decode(text, validate=True)
                except binascii.Error:
                    raise InvalidRequest(f"{header}: its {algorithm} is not base64.") from None
                self._stated.append((header, algorithm, digest))
                self._hashes.setdefault(algorithm, ALGORITHMS[algorithm]())

    def add(self, data: bytes) -> None:
        """Take in the next bytes."""
        for one in self._hashes.values():
            one.update(data)

    def check(self) -> None:
        """Compare them, after the last byte.

        Raises:
            DigestMismatch: one is another.
        """
        for header, algorithm, digest in self._stated:
            found = self._hashes[algorithm].digest()
            if found != digest:
                raise DigestMismatch(
                    f"The body does not have the digest that {header} states: its {algorithm} is "
                    f":{base64.b64encode(found).decode()}:. It changed on its way, and nothing of it was stored: send "
                    "it again."
                )
