"""Routes of keys: create, list, read, narrow and delete them; and identify the caller.

A change is on disk when it is answered, and counts for every later request.  The command line changes the same file
(``placerec keys``), so a service that nobody may manage any more can be opened again on its own machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from core import errors
from core.maps.pagination import Listing, decode_name, page_of
from service.access.gate import Gate
from service.access.keys import Key, Keys
from service.access.roles import ANONYMOUS
from service.administration.key_schemas import CreatedKey, KeyChanges, KeyPage, KeyView, NewKey, OwnKey
from service.errors.faults import (
    BodyTooLarge,
    FirstKeyLocal,
    InvalidRequest,
    KeyEnded,
    KeyExists,
    KeyWidened,
    LastAdminKey,
    MalformedBody,
    TooManyKeys,
    UnknownKey,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.openapi import json_patch
from service.http.routing import (
    WHOLE_DELETION,
    EngineDep,
    FromState,
    Page,
    PrincipalDep,
    StrictRoute,
    json_body,
    single_values,
)

LISTING: Listing = ["keys"]
BODY_PROBLEMS = (MalformedBody, BodyTooLarge, UnsupportedMediaType, errors.InvalidIdentifier)

router = APIRouter(prefix="/v1/keys", tags=["keys"], route_class=StrictRoute, dependencies=[Depends(single_values)])
own = APIRouter(prefix="/v1/key", tags=["keys"], route_class=StrictRoute, dependencies=[Depends(single_values)])

GateDep = Annotated[Gate, Depends(FromState("gate"))]
StoreDep = Annotated[Keys, Depends(FromState("key_store"))]
KeyId = Annotated[str, Path(alias="key", max_length=64, description="Id of the key.", examples=["c69fcf6b7439"])]
LockOut = Annotated[
    bool,
    Query(
        description="Go on although no key of the role admin for all maps will be in force, so that only a command on "
        "the service's machine can change keys."
    ),
]


@own.get("")
def read_own_key(gate: GateDep, store: StoreDep, principal: PrincipalDep) -> OwnKey:
    """Read the caller, and the rights of the request's key."""
    expires_at = None if principal.key_id is None else store.find(principal.key_id).expires_at
    return OwnKey(
        id=principal.key_id,
        name=principal.name,
        role=principal.role,
        maps=None if principal.maps is None else sorted(principal.maps),
        learn=principal.teaches,
        expires_at=expires_at,
        keys_needed=gate.keyring is not None and gate.keyring.demanded,
    )


@router.get("", responses=problem_documentation(errors.InvalidCursor))
def list_keys(page: Page, store: StoreDep, principal: PrincipalDep) -> KeyPage:
    """List every key that was ever created, the oldest first, without their secrets."""
    after = decode_name(LISTING, page.cursor)
    found = [key for key in store.all() if _position(key) > after]
    shown, more = page_of(LISTING, found, page.limit, _position)
    return KeyPage(items=[KeyView.of(key, principal.key_id) for key in shown], next_cursor=more)


def _position(key: Key) -> str:
    """Text that sorts as keys are listed."""
    return f"{key.created_at:%Y-%m-%dT%H:%M:%S.%f} {key.id}"


@router.post(
    "",
    status_code=201,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(*BODY_PROBLEMS, FirstKeyLocal, KeyExists, UnknownKey, TooManyKeys, LastAdminKey),
)
def create_key(
    new: NewKey,
    request: Request,
    response: Response,
    gate: GateDep,
    store: StoreDep,
    engine: EngineDep,
    principal: PrincipalDep,
    lock_out: LockOut = False,
) -> CreatedKey:
    """Create a key, which is shown only in this answer.

    The first key of a service turns keys on: from this answer on every request needs one, also once all keys are
    revoked or have expired. It has to be of the role admin for all maps, or `lock_out` has to be true. Where other
    machines can reach a service without keys, `placerec keys create` on its own machine creates the first one.
    """
    if principal is ANONYMOUS and not gate.loopback:
        raise FirstKeyLocal(
            "Other machines can reach this service, which has no keys. Create the first one on the service's own "
            "machine, with 'placerec keys create'."
        )
    request.state.noted = _noted(new.model_dump(include={"name", "role", "maps", "learn"}))
    key, token = store.create(new.name, new.role, new.maps, new.expires_at, not lock_out, new.learn, new.replaces)
    _take_effect(gate)
    request.state.noted["changed_key"] = key.id
    response.headers["Location"] = f"{engine.settings.root_path}{router.prefix}/{key.id}"
    response.headers["Cache-Control"] = "no-store"
    return CreatedKey.made(key, token)


@router.get("/{key}", responses=problem_documentation(UnknownKey))
def read_key(key_id: KeyId, store: StoreDep, principal: PrincipalDep) -> KeyView:
    """Read a key without its secret."""
    return KeyView.of(store.find(key_id), principal.key_id)


@router.patch(
    "/{key}",
    dependencies=[Depends(json_body)],
    openapi_extra=json_patch(KeyChanges),
    responses=problem_documentation(*BODY_PROBLEMS, UnknownKey, KeyEnded, KeyWidened, LastAdminKey),
)
def narrow_key(
    key_id: KeyId,
    changes: KeyChanges,
    request: Request,
    gate: GateDep,
    store: StoreDep,
    principal: PrincipalDep,
    lock_out: LockOut = False,
) -> KeyView:
    """Narrow a key by a merge patch: a lower role, fewer maps, an earlier expiry, no more learning from its runs.

    Its holder can never do more than on the day on which the key was created; for that, create another key.
    """
    given = changes.model_dump(exclude_unset=True)
    request.state.noted = _noted({"key": key_id, **given})
    if "role" in given and given["role"] is None:
        raise InvalidRequest("role: a key has a role; give query, enrol or admin.")
    if "learn" in given and given["learn"] is None:
        raise InvalidRequest("learn: give true or false.")
    if given.get("maps") is not None:
        given["maps"] = frozenset(given["maps"])
    key = store.narrow(key_id, given, keep_admin=not lock_out)
    _take_effect(gate)
    request.state.noted["changed_key_name"] = key.name
    return KeyView.of(key, principal.key_id)


@router.delete("/{key}", dependencies=[WHOLE_DELETION], responses=problem_documentation(UnknownKey, LastAdminKey))
def delete_key(
    key_id: KeyId,
    request: Request,
    gate: GateDep,
    store: StoreDep,
    engine: EngineDep,
    principal: PrincipalDep,
    lock_out: LockOut = False,
) -> KeyView:
    """Delete a key: it is revoked, so that no later request is let in with it. Repeating this changes nothing."""
    request.state.noted = _noted({"key": key_id})
    store.find(key_id)  # the store would also take a name
    key = engine.reserve.making_room(partial(store.revoke, key_id, keep_admin=not lock_out))
    _take_effect(gate)
    request.state.noted["changed_key_name"] = key.name
    return KeyView.of(key, principal.key_id)


def _take_effect(gate: Gate) -> None:
    """Let the running service know of a change before it is answered."""
    if gate.keyring is not None:
        gate.keyring.look()


def _noted(changes: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a changed key in the audit trail, under names that do not hide the caller's."""
    names = {"key": "changed_key", "name": "changed_key_name"}
    shown = {names.get(name, name): value for name, value in changes.items()}
    if shown.get("expires_at") is not None:
        shown["expires_at"] = shown["expires_at"].isoformat()
    return shown
