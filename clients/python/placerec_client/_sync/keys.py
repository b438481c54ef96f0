# Written from _async/keys.py by scripts/client.  Do not edit.
"""The keys of a service."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, Unpack

from placerec_client import models, parameters
from placerec_client._sync.connection import Connection
from placerec_client.renamed import OldNames
from placerec_client.requests import path_of
from placerec_client.retry import Retry


class Keys(OldNames, revoke="delete"):
    """The keys of a service; iterated, all that were ever created, without their secrets. They need the role admin."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._path = connection, "/v1/keys"

    def __iter__(self) -> Iterator[models.KeyView]:
        return self.list()

    def list(self) -> Iterator[models.KeyView]:
        """Yield the keys."""
        for page in self._connection.pages(models.KeyPage, self._path, {}):
            for item in page.items:
                yield item

    def create(
        self,
        name: str,
        role: Literal["query", "enrol", "admin"],
        *,
        lock_out: bool | None = None,
        **options: Unpack[parameters.NewKey],
    ) -> models.CreatedKey:
        """Create a key; its secret is in this answer only.

        It is sent once: if the answer is lost, the key may be there all the same, and should be deleted.

        Args:
            name: of the key's holder.
            role: of its holder.
            lock_out: whether it may be that nobody has the role admin afterwards.
            options: such as ``maps`` and ``expires_at``.
        """
        body = {"name": name, "role": role, **options}
        once = self._connection.patient(Retry(0))
        return once.ask(models.CreatedKey, "POST", self._path, params={"lock_out": lock_out}, json=body)

    def read(self, key_id: str) -> models.KeyView:
        """Return one key."""
        return self._connection.ask(models.KeyView, "GET", self._of(key_id))

    def narrow(self, key_id: str, changes: parameters.KeyChanges, *, lock_out: bool | None = None) -> models.KeyView:
        """Let a key do less, or for a shorter time; fields that are left out stay."""
        return self._connection.ask(
            models.KeyView, "PATCH", self._of(key_id), params={"lock_out": lock_out}, json=changes
        )

    def delete(self, key_id: str, *, lock_out: bool | None = None) -> models.KeyView:
        """Delete a key: it is revoked, so that nobody is let in with it."""
        return self._connection.ask(models.KeyView, "DELETE", self._of(key_id), params={"lock_out": lock_out})

    def _of(self, key_id: str) -> str:
        return path_of(key_id, below=self._path)
