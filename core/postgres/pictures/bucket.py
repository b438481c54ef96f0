"""Where an object store keeps pictures, and who may write there."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Bucket:
    """A bucket of a store that speaks S3.

    address: ``s3://bucket``, or ``s3://bucket/prefix`` for a part of it.
    endpoint: the address of the store, such as ``http://minio:9000``; ``https`` for TLS.  None: AWS's of the region.
    access_key, secret_key: without them, those of the machine's role.
    certificate: path of the file of the authority that the store's certificate is checked by; None: the system's.
    """

    address: str
    endpoint: str | None = None
    region: str = "us-east-1"
    access_key: str = field(default="", repr=False)
    secret_key: str = field(default="", repr=False)
    certificate: str | None = None

    @property
    def name(self) -> str:
        """Of the bucket itself."""
        return self._parts[0]

    @property
    def prefix(self) -> str:
        """The prefix of the keys of all objects, without a slash at its end; empty without one."""
        return self._parts[1].strip("/")

    @property
    def _parts(self) -> tuple[str, str]:
        name, _, prefix = self.address.removeprefix("s3://").partition("/")
        return name, prefix
