"""Keys: how they are stored, what a running service knows of them, and what no damage and no clock may open."""

from __future__ import annotations

import sqlite3
import stat
import threading
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import bindparam, delete, select, update

from core.errors import InvalidIdentifier
from core.ledger import Statement
from core.ledger.sqlite import SqliteConnection
from service.access.key_file import FILE
from service.access.key_table import KEYS
from service.access.keyring import GRACE_SECONDS, STUCK_SECONDS, USE_SECONDS, Keyring
from service.access.keys import Key, Keys
from service.access.roles import TOKEN, Principal, Role
from service.errors.faults import (
    Fault,
    InvalidRequest,
    KeyExists,
    KeyNeeded,
    KeyRefused,
    KeysUnreadable,
    KeyWidened,
    LastAdminKey,
    UnknownKey,
)

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase


class Clock:
    """A clock that is set by hand."""

    def __init__(self, now: float) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def file_store(tmp_path: Path) -> Keys:
    return Keys.of(tmp_path)


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Keys:
    """Keys in each of the two databases."""
    return Keys.of(tmp_path, None if request.param == "sqlite" else request.getfixturevalue("database"))


def bearer(token: str) -> bytes:
    return f"Bearer {token}".encode()


def ring(store: Keys, wall: Clock | None = None, monotonic: Clock | None = None) -> Keyring:
    """A keyring that looks at its file when a test says so."""
    made = Keyring(store, wall or Clock(datetime.now(UTC).timestamp()), monotonic or Clock(0.0))
    made._read()
    return made


# The database


def test_a_key_is_stored_without_its_secret(store: Keys) -> None:
    assert not store.exists() and store.all() == []
    until = datetime.now(UTC) + timedelta(days=30)
    key, token = store.create("robot-7", "query", ["lab", "yard"], until)
    match = TOKEN.fullmatch(token)
    assert match is not None and match[1] == key.id and len(match[2]) == 43, "43 of 64 characters: 256 bits"
    assert store.all() == [key]
    assert (key.role, key.maps, key.expires_at) == ("query", frozenset({"lab", "yard"}), until)
    assert match[2] not in str(store.place.execute(Statement(select(KEYS))))
    assert store.create("other", "admin")[1] != token


def test_the_file_is_its_owners_and_has_no_secret(file_store: Keys, tmp_path: Path) -> None:
    _, token = file_store.create("robot-7", "query")
    (path,) = tmp_path.iterdir()
    assert path.name == FILE and stat.S_IMODE(path.stat().st_mode) == 0o600
    assert token.split("_", 2)[2].encode() not in path.read_bytes() and token.encode() not in path.read_bytes()


def test_a_change_of_the_file_leaves_no_journal_that_could_come_back(file_store: Keys) -> None:
    file_store.create("ann", "query")
    with file_store.place.changing() as connection:
        assert isinstance(connection, SqliteConnection)
        assert connection.driver.execute("PRAGMA synchronous").fetchone() == (3,), "EXTRA, which syncs the folder"
        assert connection.driver.execute("PRAGMA journal_mode").fetchone() == ("delete",)


def test_what_cannot_be_a_key_is_refused(store: Keys) -> None:
    past = datetime.now(UTC) - timedelta(seconds=1)
    for name in ("", "two words", "a" * 65, "0123456789ab", "anonymous", "owner", "nobody", "Nobody", "new\nline"):
        with pytest.raises(InvalidRequest):
            store.create(name, "query")
    for role in ("open", "root"):
        with pytest.raises(InvalidRequest):
            store.create("ann", role)  # type: ignore[arg-type]
    with pytest.raises(InvalidRequest):
        store.create("ann", "query", None, past)
    with pytest.raises(InvalidRequest, match="learn"):
        store.create("ann", "query", learn=True)
    with pytest.raises(InvalidIdentifier):
        store.create("ann", "query", ["Not A Map"])
    assert not store.exists(), "nothing was made on the way"


def test_a_name_is_free_again_when_its_key_is_revoked(store: Keys) -> None:
    first, _ = store.create("ann", "query")
    with pytest.raises(InvalidRequest, match="Delete it first"):
        store.create("ann", "admin")
    assert store.revoke("ann").id == first.id
    moment = store.revoke(first.id).revoked_at
    second, _ = store.create("ann", "admin")
    assert store.revoke(first.id).revoked_at == moment, "once and for all"
    assert store.revoke("ann").id == second.id, "the one that was in force"
    for unknown in ("ann", "nobody", "000000000000"):
        with pytest.raises(InvalidRequest):
            store.revoke(unknown)


def test_a_key_that_replaces_another_has_its_name(store: Keys) -> None:
    old, _ = store.create("robot-7", "query")
    other, _ = store.create("robot-8", "query")
    new, _ = store.create("robot-7", "query", replaces=old.id)
    later, _ = store.create("robot-7", "query", replaces=new.id)  # while both before are still in force
    assert [key.id for key in store.all() if key.name == "robot-7"] == [old.id, new.id, later.id]
    for replaces, error in ((None, KeyExists), (other.id, KeyExists), ("0123456789ab", UnknownKey)):
        with pytest.raises(error):
            store.create("robot-7", "query", replaces=replaces)
    store.revoke(old.id)
    with pytest.raises(KeyExists):
        store.create("robot-7", "query", replaces=old.id)


@pytest.mark.thorough
def test_first_keys_at_one_moment_are_all_stored(store: Keys, tmp_path: Path) -> None:
    threads = [threading.Thread(target=store.create, args=(f"key-{number}", "query")) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {key.name for key in store.all()} == {f"key-{number}" for number in range(8)}
    assert [path.name for path in tmp_path.iterdir()] == ([] if store.place.remote else [FILE])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def _overwrite(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-300:] = b"\xff" * 300
    path.write_bytes(bytes(data))


def _replace(path: Path) -> None:
    path.unlink()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE keys (id)")


def _date_forward(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA user_version = 99")


def _share(path: Path) -> None:
    path.chmod(0o666)


@pytest.mark.parametrize(
    "damage", [_empty, _cut, _overwrite, _replace, _date_forward, _share], ids=lambda one: one.__name__
)
def test_a_damaged_file_lets_nobody_in(file_store: Keys, tmp_path: Path, damage: Callable[[Path], None]) -> None:
    _, token = file_store.create("ann", "query", ["lab"], datetime.now(UTC) + timedelta(days=1))
    expect_closed(file_store, token, lambda: damage(tmp_path / FILE))
    with pytest.raises(KeysUnreadable):
        Keyring(file_store).start()


def test_only_keys_that_say_so_teach(store: Keys) -> None:
    made = {
        "robot": store.create("robot", "query")[0],
        "mapper": store.create("mapper", "enrol")[0],
        "teacher": store.create("teacher", "enrol", learn=True)[0],
        "boss": store.create("boss", "admin")[0],
    }
    assert {key.name: key.teaches for key in store.all()} == {
        "robot": False, "mapper": False, "teacher": True, "boss": True,
    }  # fmt: skip
    with pytest.raises(KeyWidened):
        store.narrow(made["mapper"].id, {"learn": True})
    with pytest.raises(InvalidRequest, match="query"):
        store.narrow(made["teacher"].id, {"role": "query", "learn": True})
    with pytest.raises(InvalidRequest, match="admin"):
        store.narrow(made["boss"].id, {"learn": False})
    assert store.narrow(made["boss"].id, {"role": "enrol"}).teaches, "what it had, and was not narrowed"
    assert not store.narrow(made["boss"].id, {"learn": False}).teaches
    assert not store.narrow(made["teacher"].id, {"role": "query"}).teaches
    assert [key.teaches for key in store.all()] == [False] * 4


@pytest.mark.parametrize(
    "change", [{"role": "query+learn"}, {"role": "admin", "maps": None}, {"expires_at": None}, {"digest": bytes(32)}]
)
def test_a_row_that_was_changed_lets_nobody_in(store: Keys, change: dict[str, Any]) -> None:
    _, token = store.create("ann", "query", ["lab"], datetime.now(UTC) + timedelta(days=1))

    def forge() -> None:
        with store.place.changing() as connection:
            assert connection.change(
                Statement(update(KEYS).values({name: bindparam(name) for name in change})), **change
            )

    expect_closed(store, token, forge)


def expect_closed(store: Keys, token: str, damage: Callable[[], None]) -> None:
    """Nobody is let in after some damage, at a running service neither."""
    clock = Clock(0.0)
    running = ring(store, monotonic=clock)
    damage()
    assert store.exists(), "keys are demanded all the same"
    for action in (store.all, lambda: store.create("bob", "admin"), lambda: store.revoke("ann"), lambda: ring(store)):
        with pytest.raises(KeysUnreadable):
            action()
    running.look()
    clock.now += GRACE_SECONDS
    running.look()
    for header in (bearer(token), None):
        with pytest.raises(KeysUnreadable):
            running.principal(header)
    assert running.demanded


def test_a_directory_without_keys_gets_no_file(file_store: Keys, tmp_path: Path) -> None:
    with pytest.raises(InvalidRequest):
        file_store.revoke("ann")
    with pytest.raises(LastAdminKey):
        file_store.create("ann", "query", keep_admin=True)
    assert file_store.all() == [] and list(tmp_path.iterdir()) == []


UNTIL = datetime.now(UTC) + timedelta(days=30)
Step = tuple[str, str, Role, frozenset[str] | None, bool]
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["create", "narrow", "revoke", "use"]),
        st.sampled_from(["ann", "bob", "eve"]),
        st.sampled_from(["query", "enrol", "admin"]),
        st.sampled_from([None, frozenset({"lab"}), frozenset({"lab", "yard"})]),
        st.booleans(),
    ),
    max_size=15,
)


def outcome(store: Keys, step: Step) -> object:
    """What comes of a step: what the key is then, or the error."""
    action, name, role, maps, keep_admin = step
    found = [key.id for key in store.all() if key.name == name]
    try:
        if action == "create":
            return traits(store.create(name, role, maps, UNTIL, keep_admin)[0])
        if action == "narrow":
            return traits(store.narrow(found[-1] if found else name, {"role": role, "maps": maps}, keep_admin))
        if action == "revoke":
            return traits(store.revoke(name, keep_admin))
        if found:
            store.note_uses(dict.fromkeys(found, UNTIL))
    except Fault as error:
        return type(error)
    return None


def traits(key: Key) -> tuple[object, ...]:
    """A key without what is made at random."""
    return key.name, key.role, key.maps, key.expires_at, key.revoked_at is None, key.last_used_at


@pytest.mark.thorough
@pytest.mark.postgres
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(STEPS)
def test_random_changes_do_the_same_in_both_databases(
    database: SharedDatabase, tmp_path_factory: pytest.TempPathFactory, steps: list[Step]
) -> None:
    folder = tmp_path_factory.mktemp("keys")
    database.change("forget all keys", Statement(delete(KEYS)))
    shared, file = Keys.of(folder, database), Keys.of(folder)
    for step in steps:
        assert outcome(shared, step) == outcome(file, step), step
        assert [traits(key) for key in shared.all()] == [traits(key) for key in file.all()]
        assert shared.exists() == file.exists()


# A running service


def test_who_is_let_in(store: Keys) -> None:
    _, token = store.create("robot", "query", ["lab"])
    running = ring(store)
    principal = running.principal(bearer(token))
    assert principal == Principal("robot", store.all()[0].id, "query", frozenset({"lab"}))
    assert principal.may_use("lab") and not principal.may_use("yard") and not principal.may_use("lab", "yard")
    assert not principal.may_use(None), "what is of no map is not of this one"
    assert running.principal(b"bearer  " + token.encode() + b" ") == principal
    for header in (None, b"", b"Bearer", b"Basic YTpi", token.encode()):
        with pytest.raises(KeyNeeded):
            running.principal(header)
    other = token[:-1] + ("A" if token[-1] != "A" else "B")
    unknown = "placerec_000000000000_" + token[-43:]
    for wrong in (bearer(other), bearer(unknown), bearer(token[:-1]), bearer(token) + b"\xff"):
        with pytest.raises(KeyRefused, match="This key is not known"):
            running.principal(wrong)


def test_a_running_service_learns_of_every_change(store: Keys) -> None:
    running = Keyring(store)
    running.look()
    assert not running.demanded
    _, first = store.create("ann", "query")
    running.look()
    assert running.demanded and running.principal(bearer(first)).name == "ann"
    _, second = store.create("bob", "query")
    running.look()
    assert running.principal(bearer(second)).name == "bob"
    store.revoke("ann")
    running.look()
    with pytest.raises(KeyRefused, match="revoked"):
        running.principal(bearer(first))
    store.revoke("bob")
    running.look()
    assert running.demanded, "also when no key is in force"
    running.close()


def test_a_file_that_is_away_for_a_moment_and_for_good(file_store: Keys, tmp_path: Path) -> None:
    _, token = file_store.create("ann", "query")
    clock = Clock(0.0)
    running = ring(file_store, monotonic=clock)
    path, aside = tmp_path / FILE, tmp_path / "aside"
    path.rename(aside)
    running.look()
    assert running.principal(bearer(token)).name == "ann", "another process may be putting it in place"
    clock.now += GRACE_SECONDS
    running.look()
    with pytest.raises(KeysUnreadable, match="is gone"):
        running.principal(bearer(token))
    aside.rename(path)
    running.look()
    assert running.principal(bearer(token)).name == "ann"


def test_a_disk_that_does_not_answer_ends_what_nobody_can_check(store: Keys) -> None:
    _, token = store.create("ann", "query")
    clock = Clock(0.0)
    running = Keyring(store, monotonic=clock)
    running._read()
    running._thread = threading.current_thread()  # which is stuck
    assert running.principal(bearer(token)).name == "ann"
    clock.now += STUCK_SECONDS + 1
    with pytest.raises(KeysUnreadable):
        running.principal(bearer(token))


def test_a_key_expires_and_no_clock_brings_it_back(store: Keys) -> None:
    made = datetime.now(UTC)
    _, token = store.create("ann", "query", None, made + timedelta(days=30))
    _, lasting = store.create("bob", "query")
    wall, monotonic = Clock(made.timestamp()), Clock(1000.0)
    running = ring(store, wall, monotonic)
    wall.now += 31 * 86400
    with pytest.raises(KeyRefused, match="expired"):
        running.principal(bearer(token))
    wall.now = made.timestamp()
    assert running.principal(bearer(token)), "the clock was wrong for a moment, which costs nobody a key"
    monotonic.now += 30 * 86400  # the clock was set back again and again
    with pytest.raises(KeyRefused, match="expired"):
        running.principal(bearer(token))
    assert running.principal(bearer(lasting))


def test_a_clock_that_is_set_back_prolongs_no_use(store: Keys) -> None:
    made = datetime.now(UTC)
    _, token = store.create("ann", "query", None, made + timedelta(days=30))
    long_ago = made.timestamp() - 10 * 365 * 86400
    for _ in range(3):  # restarts, each with a clock of ten years ago
        monotonic = Clock(0.0)
        running = ring(store, Clock(long_ago), monotonic)
        running.principal(bearer(token))
        monotonic.now += 9 * 86400 + USE_SECONDS
        running.principal(bearer(token))
        running.look()
        running.close()
    with pytest.raises(KeyRefused, match="expired"):  # after 27 days
        monotonic = Clock(0.0)
        running = ring(store, Clock(long_ago), monotonic)
        monotonic.now += 4 * 86400
        running.principal(bearer(token))


def test_last_uses_are_written_now_and_then(store: Keys) -> None:
    _, token = store.create("ann", "query")
    before = datetime.now(UTC)
    monotonic = Clock(0.0)
    running = ring(store, monotonic=monotonic)
    running.principal(bearer(token))
    running.look()
    assert store.all()[0].last_used_at is None
    monotonic.now += USE_SECONDS
    running.look()
    used = store.all()[0].last_used_at
    assert used is not None and abs((used - before).total_seconds()) < 60
    assert running.principal(bearer(token)), "its own note does not disturb it"
    running.close()
