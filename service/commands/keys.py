"""``placerec keys``: create, list and delete the keys of a data directory, which a service may be using."""

from __future__ import annotations

import atexit
import re
from dataclasses import replace
from datetime import UTC, datetime, time, timedelta
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from service.commands.connection.client import AsJson, DataDir
from service.commands.console import Commands, Failure, remark, show, show_json, table
from service.commands.options.settings import read_settings

if TYPE_CHECKING:
    from service.access.keys import Key, Keys, KeyState

keys = typer.Typer(cls=Commands, help="Create, list and delete the keys of a data directory.", no_args_is_help=True)

UNITS = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
SPAN = re.compile(r"([0-9]{1,6})([mhdw])")


@keys.command("create")
def create(
    name: Annotated[str, typer.Argument(help="The holder of the key; the name appears in logs.", show_default=False)],
    role: Annotated[
        Literal["query", "enrol", "admin"],
        typer.Option(help="Permissions: enrol includes query, and admin includes everything.", show_default=False),
    ],
    maps: Annotated[
        list[str] | None, typer.Option("--map", "-m", help="Limit the key to this map; may be repeated.")
    ] = None,
    learn: Annotated[
        bool, typer.Option("--learn", help="Maps that learn do so from its runs; for the role enrol.")
    ] = False,
    expires: Annotated[
        str | None, typer.Option(help="When it expires: after 30m, 12h, 30d or 8w, or at a date (UTC).")
    ] = None,
    lock_out: Annotated[
        bool, typer.Option("--lock-out", help="Create it also if no key could manage the service then.")
    ] = False,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Create a key and write it to standard output. It is shown only this once and stored nowhere.

    As soon as a data directory has its first key, every request needs one; a running service knows within a second.
    That remains so even when all keys are revoked or have expired. So the first key is one of the role admin for all
    maps, unless --lock-out says that nobody is to manage the service.
    """
    from service.errors.faults import LastAdminKey

    store = _store(data_dir)
    is_first = not store.exists()
    until = None if expires is None else moment(expires)
    try:
        key, token = store.create(name, role, maps or None, until, keep_admin=not lock_out, learn=learn)
    except LastAdminKey as error:
        raise Failure(
            "Every request would need a key, and none in force could manage the service. Create an admin key for all "
            "maps first ('placerec keys create NAME --role admin'), or give --lock-out."
        ) from error
    _note(data_dir, "create_key", key, 201, role=key.role, maps=maps or None, learn=key.learn)
    if as_json:
        show_json(_view(key) | {"key": token})
    else:
        typer.echo(token)
    if is_first:
        remark("From now on every request needs a key.")
    remark(f"The key {key.name} ({key.id}, {_described(key)}) is shown only this once. Store it now.")
    for absent in _absent(data_dir, maps or []):
        remark(f"There is no map {absent} yet: is the name mistyped? The maps of a key cannot be changed here.")


@keys.command("list")
def list_keys(data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List every key that was ever created, without its secret. The last use may be a minute out of date."""
    found = _store(data_dir).all()
    if as_json:
        show_json([_view(key) for key in found])
        return
    shown = table("id", "name", "role", "learn", "maps", "state", "created", "expires", "last used")
    for key in found:
        maps = "all" if key.maps is None else ",".join(sorted(key.maps))
        moments = (_shown(moment) for moment in (key.created_at, key.expires_at, key.last_used_at))
        shown.add_row(key.id, key.name, key.role, "yes" if key.teaches else "no", maps, _state_of(key), *moments)
    show(shown)
    if not found:
        folder = read_settings(data_dir).data_dir
        remark(f"No key was ever created in the data directory {folder}, so a service on it needs none.")


@keys.command("delete")
def delete(
    wanted: Annotated[str, typer.Argument(metavar="ID|NAME", help="Id or name of the key.", show_default=False)],
    data_dir: DataDir = None,
) -> None:
    """Delete a key: it is revoked, so that nobody is let in with it; a running service knows within a second."""
    store = _store(data_dir)
    deleted = store.revoke(wanted)
    _note(data_dir, "delete_key", deleted, 200)
    remark(f"The key {deleted.name} ({deleted.id}) is deleted.")
    if not any(_state_of(other) == "in force" for other in store.all()):
        remark("No key is in force now: the service refuses every request that needs one.")


def moment(text: str) -> datetime:
    """Parse a span from now, a date, or a date and time, which is in UTC unless it has an offset.

    Raises:
        Failure: the text is none of them.
    """
    span = SPAN.fullmatch(text)
    if span is not None:
        return datetime.now(UTC) + timedelta(**{UNITS[span[2]]: int(span[1])})
    try:
        found = datetime.fromisoformat(text)
    except ValueError as error:
        raise Failure(f"{text!r} is neither a span such as 30d nor a date such as 2027-01-31.") from error
    if len(text) == len("2027-01-31"):
        found = datetime.combine(found.date(), time())
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def _store(data_dir: Any) -> Keys:
    from service.access.keys import Keys  # with it comes SQLAlchemy
    from service.shared import open_database

    settings = read_settings(data_dir)
    database = open_database(settings)
    if database is not None:
        atexit.register(database.close)
    return Keys.of(settings.data_dir, database)


def _absent(data_dir: Any, maps: list[str]) -> list[str]:
    """Those of the maps that the data directory does not have; none if maps are in a database."""
    from core.store.directory import has_map

    settings = read_settings(data_dir)
    return [name for name in maps if settings.database is None and not has_map(settings.data_dir, name)]


def _note(data_dir: Any, operation: str, key: Key, status: int, **fields: object) -> None:
    """Have the audit file, if there is one, say what was changed, as over HTTP."""
    from service.access.audit import ASKER, note_change
    from service.administration.audit_trail import audit_trail

    file = read_settings(data_dir).audit_file
    if file is None:
        return
    with audit_trail(file):
        changed = {"changed_key": key.id, "changed_key_name": key.name}
        note_change(replace(ASKER.get(), operation=operation), {}, {**changed, **fields}, status)


def _state_of(key: Key) -> KeyState:
    """Whether a key is in force by this machine's clock."""
    from service.access.keys import state_of

    return state_of(key, datetime.now(UTC))


def _described(key: Key) -> str:
    maps = "all maps" if key.maps is None else f"maps {', '.join(sorted(key.maps))}"
    role = f"{key.role} with learn" if key.learn else key.role
    return f"{role}, {maps}, {'no expiry' if key.expires_at is None else f'until {_shown(key.expires_at)}'}"


def _shown(moment: datetime | None) -> str:
    return "–" if moment is None else f"{moment:%Y-%m-%d %H:%M}"


def _view(key: Key) -> dict[str, Any]:
    moments = {name: getattr(key, name) for name in ("created_at", "expires_at", "revoked_at", "last_used_at")}
    return {
        "id": key.id,
        "name": key.name,
        "role": key.role,
        "maps": None if key.maps is None else sorted(key.maps),
        "learn": key.teaches,
        "state": _state_of(key),
        **{name: None if at is None else at.isoformat() for name, at in moments.items()},
    }
