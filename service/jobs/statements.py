"""The statements of the table of jobs.

Of their parameters, ``service`` is the id of the service that executes them, ``living`` are those of the services that
are there, ``kinds`` the kinds of jobs that it can do, ``own`` the ids of jobs of other kinds that it alone can do, and
``held`` those of the jobs that it does.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import BindParameter, bindparam, case, delete, exists, func, not_, null, select, update

from core.ledger import Statement
from core.ledger.statements import among
from service.jobs.rows import JOBS, READ

_jobs, _waiting, _other = JOBS.c, JOBS.alias("waiting").c, JOBS.alias("other").c
_service: BindParameter[str] = bindparam("service")
_now: BindParameter[float] = bindparam("now")
_given: dict[str, Any] = {column.name: bindparam(column.name) for column in READ}

ALL = Statement(select(*READ).order_by(_jobs.number))
GET = Statement(select(*READ).where(_jobs.id == bindparam("id")))
COUNTS = Statement(select(_jobs.state, func.count()).group_by(_jobs.state))
QUEUED = Statement(select(func.count()).where(_jobs.state == "queued"))
WAITING_ASKERS = Statement(select(_jobs.asker).where(_jobs.state == "queued"))
HELD = Statement(
    select(_jobs.id, _jobs.attempt, _jobs.cancelling).where(_jobs.owner == _service, _jobs.state == "running")
)
_new = {name: value for name, value in _given.items() if name != "number"} | {"yielded": 0}
ADD = Statement(lambda insert: insert(JOBS).values(_new).returning(_jobs.number))
PUT = Statement(
    lambda insert: (
        insert(JOBS).values({**_given, "yielded": 0}).on_conflict_do_update(index_elements=["number"], set_=_given)
    )
)
"""Write a whole job, in place of one that cannot be read."""

# The next job

_is_ours = (_waiting.home.is_(None) | (_waiting.home == _service)) & (
    ((_waiting.resumable == 1) & among(_waiting.kind, "kinds")) | among(_waiting.id, "own")
)
_is_earlier = (_other.number < _waiting.number) & (_other.home.is_(None) | among(_other.home, "living"))
_holds_up = exists().where(
    _other.map == _waiting.map,
    _other.number != _waiting.number,
    _other.ended_at.is_(None),
    (_other.state == "running") | _is_earlier,
)
_is_ready = (_waiting.state == "queued") & _is_ours & (_waiting.map.is_(None) | not_(_holds_up))
_next = (
    select(_waiting.number)
    .where(_is_ready)
    .order_by(func.coalesce(_waiting.behind, _waiting.number), _waiting.yielded, _waiting.number)
    .limit(1)
)
TAKE = Statement(
    update(JOBS)
    .where(_jobs.number == _next.scalar_subquery())
    .values(state="running", owner=_service, attempt=_jobs.attempt + 1, change=0, started_at=_now)
    .returning(*READ, _jobs.yielded)
)
OTHERS_WAIT = Statement(
    select(_waiting.number)
    .where(_is_ready, _waiting.map.is_(None) | _waiting.map.is_distinct_from(bindparam("of_map")))
    .limit(1)
)

# Writes of the service that does a job, in the attempt in which it took it


def _of_owner(*names: str, **values: Any) -> Statement:
    owned = (_jobs.number == _given["number"]) & (_jobs.owner == _service) & (_jobs.attempt == _given["attempt"])
    written = {name: _given[name] for name in ("change", "done", "total", "message", *names)}
    return Statement(
        update(JOBS).where(owned, _jobs.state == "running").values(written | values).returning(_jobs.cancelling)
    )


_back = {"state": "queued", "owner": null(), "behind": null(), "yielded": 0}
_behind_all = {
    "behind": select(func.max(_other.number)).scalar_subquery(),
    "yielded": select(func.max(_other.yielded) + 1).scalar_subquery(),
}
PROGRESS = _of_owner()
NOTE = _of_owner("notes")
END = _of_owner("state", "ended_at", "notes", "result", "problem")
PUT_OFF = _of_owner(**_back)
GIVE_WAY = _of_owner(**{**_back, **_behind_all})

# Writes without an owner

_later = {"change": _jobs.change + 1}
_has_no_home = not_(among(_jobs.home, "living"))
_is_clean = (_jobs.attempt == 0) | (_jobs.yielded > 0) | _has_no_home
CANCEL_WAITING = Statement(
    update(JOBS)
    .where(_jobs.id == bindparam("id"), _jobs.state == "queued", _is_clean)
    .values({**_later, "state": "cancelled", "ended_at": _now, "notes": "{}"})
)
CANCEL = Statement(
    update(JOBS)
    .where(_jobs.id == bindparam("id"), _jobs.ended_at.is_(None), _jobs.cancelling == 0)
    .values({**_later, "cancelling": 1})
)
_cannot_be_done_here = (_jobs.resumable == 0) | not_(among(_jobs.kind, "kinds"))
_is_lost_here = (_jobs.home == _service) & not_(among(_jobs.id, "own")) & _cannot_be_done_here
LOST = Statement(select(*READ).where(_jobs.ended_at.is_(None), _is_lost_here | ((_jobs.resumable == 0) & _has_no_home)))
FAIL = Statement(
    update(JOBS)
    .where(_jobs.number == bindparam("number"), _jobs.ended_at.is_(None))
    .values({**_later, "state": "failed", "ended_at": _now, "notes": "{}", "problem": _given["problem"]})
    .returning(*READ)
)
_is_left_here = (_jobs.owner == _service) & not_(among(_jobs.id, "held"))
_message = case(
    (_jobs.owner == _service, "waits to be resumed after a restart of the service"),
    (_jobs.home.is_(None), "waits to be resumed after a service has ended"),
    else_="waits for the service that has its files",
)
LET_GO = Statement(
    update(JOBS)
    .where(_jobs.state == "running", _jobs.resumable == 1, _is_left_here | not_(among(_jobs.owner, "living")))
    .values({**_later, **_back, "message": _message})
    .returning(*READ)
)
_oldest = select(_other.number).where(_other.ended_at.is_not(None)).order_by(_other.number.desc()).limit(1)
TRIM = Statement(
    delete(JOBS)
    .where(_jobs.ended_at.is_not(None), _jobs.number <= _oldest.offset(bindparam("history")).scalar_subquery())
    .returning(_jobs.id)
)
