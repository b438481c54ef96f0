"""JSON of keys."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from core.places import Timestamp
from service.access.keys import Key, KeyState, state_of
from service.access.roles import Role
from service.http.schemas import Cursor

MOST_MAPS = 1000
"""Maps that one key may be limited to."""

KeyRole = Literal["query", "enrol", "admin"]
MapIds = Annotated[list[Annotated[str, Field(max_length=64)]], Field(min_length=1, max_length=MOST_MAPS)]

NEW_KEY_EXAMPLE: dict[str, Any] = {
    "name": "robot-7",
    "role": "query",
    "maps": ["lab"],
    "learn": False,
    "expires_at": "2027-01-31T00:00:00Z",
}
KEY_EXAMPLE: dict[str, Any] = {
    "id": "c69fcf6b7439",
    **NEW_KEY_EXAMPLE,
    "state": "in force",
    "created_at": "2026-11-20T09:00:00Z",
    "revoked_at": None,
    "last_used_at": "2026-11-22T18:02:31Z",
    "own": False,
}


class KeyView(BaseModel):
    """A key without its secret."""

    model_config = ConfigDict(json_schema_extra={"examples": [KEY_EXAMPLE]})

    id: str
    name: str = Field(description="Whose it is; it appears in logs and in the audit trail.")
    role: KeyRole
    maps: list[str] | None = Field(description="Ids of the maps that it is limited to; null: all maps.")
    learn: bool = Field(
        description="Whether maps that learn do so from the runs of its holder. An option of the role enrol; admin "
        "includes it."
    )
    state: KeyState
    created_at: Timestamp
    expires_at: Timestamp | None
    revoked_at: Timestamp | None
    last_used_at: Timestamp | None = Field(description="It may be a minute out of date.")
    own: bool = Field(description="Whether it is the key with which this request was sent.")

    @classmethod
    def of(cls, key: Key, asking: str | None) -> KeyView:
        """The JSON view of a key.

        Args:
            asking: the id of the key with which the request was sent; None without one.
        """
        return cls.model_construct(**_fields(key, asking))


class CreatedKey(KeyView):
    """A new key with its secret."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [KEY_EXAMPLE | {"last_used_at": None, "key": "placerec_c69fcf6b7439_…"}]}
    )

    key: str = Field(description="The key as its holder sends it. It is shown only this once, and stored nowhere.")

    @classmethod
    def made(cls, key: Key, token: str) -> CreatedKey:
        """The JSON view of a key that was just created."""
        return cls.model_construct(**_fields(key, None), key=token)


def _fields(key: Key, asking: str | None) -> dict[str, Any]:
    names = ("id", "name", "role", "created_at", "expires_at", "revoked_at", "last_used_at")
    maps = None if key.maps is None else sorted(key.maps)
    shown = {name: getattr(key, name) for name in names}
    state = state_of(key, datetime.now(UTC))
    return {**shown, "maps": maps, "learn": key.teaches, "state": state, "own": key.id == asking}


class KeyPage(BaseModel):
    """A page of keys, the oldest first, revoked ones included."""

    items: list[KeyView]
    next_cursor: Cursor


class NewKey(BaseModel):
    """A key to create."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [NEW_KEY_EXAMPLE]})

    name: str = Field(
        max_length=64,
        description="Whose key it is: at most 64 letters, digits and . _ @ -, unique among keys in force.",
    )
    role: KeyRole = Field(description="enrol includes query, and admin includes everything.")
    maps: MapIds | None = Field(default=None, description="Limit it to these maps; null or left out: all maps.")
    learn: bool = Field(
        default=False,
        strict=True,
        description="Whether maps that learn do so from the runs of its holder. An option of the role enrol; admin "
        "includes it.",
    )
    expires_at: Timestamp | None = Field(default=None, description="When it expires; null or left out: never.")
    replaces: str | None = Field(
        default=None,
        max_length=64,
        description="The id of a key in force whose name this one has, to take its place. Then end that one, by its "
        "`expires_at` or by deleting it.",
    )


class KeyChanges(BaseModel):
    """A merge patch (RFC 7396) of a key; fields that are left out stay. The key can only be narrowed."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"role": "query", "maps": ["lab"]}]})

    role: KeyRole | None = Field(default=None, description="Not higher than now.")
    maps: MapIds | None = Field(default=None, description="Some of the present ones; null: all maps.")
    learn: bool | None = Field(default=None, strict=True, description="false: no map learns from its runs any more.")
    expires_at: Timestamp | None = Field(default=None, description="Not later than now; null: never.")


class OwnKey(BaseModel):
    """The caller, and the caller's rights."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "c69fcf6b7439",
                    "name": "robot-7",
                    "role": "query",
                    "maps": ["lab"],
                    "learn": False,
                    "expires_at": "2027-01-31T00:00:00Z",
                    "keys_needed": True,
                }
            ]
        }
    )

    id: str | None = Field(description="Null if the service has no keys.")
    name: str
    role: Role
    maps: list[str] | None = Field(description="Ids of the maps that the key is limited to; null: all maps.")
    learn: bool = Field(description="Whether maps that learn do so from its runs.")
    expires_at: Timestamp | None
    keys_needed: bool = Field(description="Whether a request needs a key; false on a service without keys.")
