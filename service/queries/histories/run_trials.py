"""The answers to frames whose place a run knew beyond doubt, in the tables of counted answers: numbers, no frames.

Of each map those of the latest runs are stored.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from sqlalchemy import bindparam, delete, select

from core.judgement.trials import StagedTrials
from core.learning import Witness
from core.ledger import LedgerConnection, Statement
from service.queries.count_tables import MAPS, RUN_TRIALS, THE_MAP, number_of, of_map, putting
from service.queries.given_answers import MapKey

MOST_RUNS = 20
"""Runs of a map of which trials are stored; a longer run counts as several.  No robot displaces those of others while
it has more of them."""


@dataclass(frozen=True)
class RunTrials:
    """The trials of one run, or of a part of a long one.

    run: the session.
    source: its robot, and when it began.
    at: when they were stored; None: they are not yet.
    """

    run: str
    source: Witness
    trials: StagedTrials
    at: datetime | None = None

    @property
    def frames(self) -> int:
        """How many frames they are of."""
        return len(np.unique(self.trials.two.frame))


_R = RUN_TRIALS.c
_PUT = putting(RUN_TRIALS, lambda _, new: new)
_STORED = Statement(select(_R.run, _R.at, _R.source).where(of_map(RUN_TRIALS)).order_by(_R.at, _R.run))
_DELETE = Statement(
    delete(RUN_TRIALS).where(of_map(RUN_TRIALS), _R.run == bindparam("run"), _R.at == bindparam("moment"))
)
_OF_MAP = Statement(
    select(_R.run, _R.source, _R.trials, _R.at).join_from(RUN_TRIALS, MAPS).where(*THE_MAP).order_by(_R.at, _R.run)
)
_FORGET = Statement(
    delete(RUN_TRIALS).where(
        RUN_TRIALS.c.map == select(MAPS.c.code).where(*THE_MAP).scalar_subquery(), _R.run == bindparam("run")
    )
)


def put_run_trials(connection: LedgerConnection, key: MapKey, at: str, ran: RunTrials) -> None:
    """Add the trials of a run to those of a map.

    If there are too many, the robot that has most of them loses those of its oldest run: many runs of one leave what
    others have said.
    """
    code = number_of(connection, key, at)
    connection.execute(_PUT, rows=json.dumps([(code, ran.run, at, str(ran.source), json.dumps(ran.trials.record()))]))
    rows = connection.execute(_STORED, code=code)
    stored = [(run, moment, Witness.of(source).robot) for run, moment, source in rows]
    while len(stored) > MOST_RUNS:
        counts = Counter(robot for _, _, robot in stored)
        oldest = next(one for one in stored if counts[one[2]] == max(counts.values()))
        connection.execute(_DELETE, code=code, run=oldest[0], moment=oldest[1])
        stored.remove(oldest)


def read_run_trials(connection: LedgerConnection, key: MapKey) -> list[RunTrials]:
    """The trials of the latest runs of a map, oldest first."""
    rows = connection.execute(_OF_MAP, id=key[0], made=key[1])
    return [
        RunTrials(run, Witness.of(source), StagedTrials.of_record(json.loads(trials)), datetime.fromisoformat(moment))
        for run, source, trials, moment in rows
    ]


def forget_run_trials(connection: LedgerConnection, key: MapKey, run: str) -> None:
    """Delete the trials of a run."""
    connection.execute(_FORGET, id=key[0], made=key[1], run=run)
