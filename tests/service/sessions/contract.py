"""What is asked of everything that keeps sessions: random writes, with a model in plain values beside them."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import strategies as st

from service.sessions.store import SessionRecords, StoredSession

IDS = ("s-1", "s-2", "s-3")
KINDS = ("write", "renew", "end", "forget")

STEPS = st.lists(
    st.tuples(st.sampled_from(KINDS), st.sampled_from(IDS), st.integers(0, 2**53), st.binary(max_size=40)), max_size=30
)


def _session(session_id: str, number: int, state: bytes) -> StoredSession:
    options = '{"expires_after": 900.0}'
    return StoredSession(
        session_id, "lab", "2026", options, 1.0, 2.0, number, number / 7, f"request {number}", number % 3, None, state,
        f'{{"frame": {number}}}',
    )  # fmt: skip


def _without_times(session: StoredSession | None) -> StoredSession | None:
    return None if session is None else replace(session, created=0.0, used=0.0)


def check_records(records: SessionRecords, steps: list[tuple[str, str, int, bytes]]) -> None:
    """Do the steps; after each, every session is as the model has it."""
    model: dict[str, StoredSession] = {}
    revisions: dict[str, int] = {}
    for kind, session_id, number, state in steps:
        known, session = model.get(session_id), _session(session_id, number, state)
        if kind == "write" and known is None:
            records.write(session)
            model[session_id], revisions[session_id] = session, 0
        elif kind == "renew":
            lives = known is not None and known.ended is None
            assert records.renew(session, revisions.get(session_id, 0)) == lives
            if lives:
                model[session_id], revisions[session_id] = session, revisions[session_id] + 1
        elif kind == "end" and known is not None and known.ended is None:
            records.end(session_id, "over", 9.0)
            model[session_id] = replace(known, ended="over", state=None, answer=None)
        elif kind == "forget":
            records.forget(session_id)
            model.pop(session_id, None)
        for name in IDS:
            assert _without_times(records.read(name)) == _without_times(model.get(name))
        assert {one.id for one in records.all()} == set(model)
