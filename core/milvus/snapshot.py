"""Searching a map that is in PostgreSQL and Milvus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownPlace
from core.judgement.priors import LARGEST_TRUST, Constraint, InSequences, NotLately, Values, holding, log_weights
from core.ledger.maps import places, sequences
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace, tokens_of, wanted_tokens, whereabouts_of
from core.ledger.maps.record import MapState
from core.ledger.postgres import PostgresLedger
from core.maps.records import COMPACT_FROM
from core.maps.selection import Conditions, Selection
from core.maps.store import Ranking, Rows, merged
from core.milvus.collection import MOST_FOUND, Collection
from core.milvus.expressions import all_of, any_row, bounds_of, with_tokens
from core.places import NO_LEVEL, NO_POSE, Neighborhood, Whereabouts, place_and_look
from core.postgres import rows as stored_rows
from core.postgres.forms import Form

SHORTLIST = 100
"""Places of a large map that a search finds, as in a data directory; below ``COMPACT_FROM`` places it finds all."""

MOST_KNOWN = 10_000
"""Places that a snapshot remembers, so that what was read of a place stays as it was."""

_SPARE = 1.25  # the factor of entities requested, for some are no place's any more or beyond an edge
_MORE = 4  # by this factor, if these were too few

Keep = Callable[[list[StoredPlace]], NDArray[np.bool_]]
"""Which of some places fulfil conditions; bool [n]."""


@dataclass(frozen=True, eq=False)
class MilvusSnapshot:
    """The places of a map at one moment (:class:`core.maps.store.Snapshot`).

    Later writes to the map may show in rows that are read for the first time: a row belongs to the same
    frame for ever, but its place may have got another pose.

    state: of the map at that moment.
    orphans: the keys of entities that were no place's any more.
    """

    database: PostgresLedger
    collection: Collection
    state: MapState
    orphans: tuple[int, ...] = ()
    _known: dict[int, StoredPlace] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.state.searched

    @property
    def rows(self) -> int:
        return self.state.rows

    def entries_at(self, rows: Rows) -> list[StoredPlace]:
        """The places of rows that a search found, as it found them, and else as they are now.

        Raises:
            UnknownPlace: the place of a row was deleted, or got another frame, before it was requested.
        """
        found = {row: entry for row in rows.tolist() if (entry := self._known.get(row)) is not None}
        if missing := [row for row in rows.tolist() if row not in found]:
            with self.database.reading() as whole:
                read = places.at_rows(MapConnection(whole, self.state.number), missing)
            self.note(list(read.values()))
            found |= read
        try:
            return [found[row] for row in rows.tolist()]
        except KeyError:
            raise UnknownPlace("A place was deleted while it was read.") from None

    def note(self, entries: Sequence[StoredPlace]) -> None:
        """Remember places that were read, as long as there are not too many."""
        if len(self._known) + len(entries) > MOST_KNOWN:
            return
        for entry in entries:
            self._known.setdefault(entry.row, entry)

    def whereabouts_at(self, rows: Rows) -> Whereabouts:
        return whereabouts_of(self.entries_at(rows))

    def descriptors_at(self, rows: Rows) -> NDArray[np.float32]:
        """The descriptors of rows: float32 [k, D]."""
        return Form(self.state.record).descriptors(self._stored(stored_rows.descriptors_at, rows))

    def locals_at(self, rows: Rows) -> NDArray[np.int8]:
        """The local descriptors of rows: int8 [k, C, L]."""
        return Form(self.state.record).locals(self._stored(stored_rows.locals_at, rows))

    def _stored(self, read: Callable[[MapConnection, Sequence[int]], dict[int, bytes]], rows: Rows) -> list[bytes]:
        with self.database.reading() as whole:
            found = read(MapConnection(whole, self.state.number), np.unique(rows).tolist())
        try:
            return [found[row] for row in rows.tolist()]
        except KeyError:
            raise UnknownPlace("A place was deleted while it was read.") from None

    @cached_property
    def all_entries(self) -> list[StoredPlace]:
        """All places of the rows of the snapshot."""
        with self.database.reading() as whole:
            entries = places.listed_with_looks(MapConnection(whole, self.state.number), -1, 1 << 62)
        found = [entry for entry in entries if entry.row < self.rows]
        self.note(found)
        return found

    @cached_property
    def alive(self) -> NDArray[np.bool_]:
        alive = np.zeros(self.rows, np.bool_)
        alive[[entry.row for entry in self.all_entries]] = True
        return alive

    @cached_property
    def whereabouts(self) -> Whereabouts:
        """Where and when the frames of all rows were taken; rows of no place have no pose and no sequence."""
        where = Whereabouts.along_sequence(np.zeros(self.rows, np.int64)).take(np.arange(self.rows))
        columns = {name: column.copy() for name, column in vars(where).items()}
        columns["sequence"][:] = columns["track"][:] = -1
        found = whereabouts_of(self.all_entries)
        for name, column in columns.items():
            column[[entry.row for entry in self.all_entries]] = getattr(found, name)
        return Whereabouts(**columns)

    def among(self, allowed: NDArray[np.bool_]) -> MilvusScope:
        inside, outside = np.flatnonzero(allowed & self.alive), np.flatnonzero(~allowed & self.alive)
        few = any_row(inside.tolist()) if len(inside) <= len(outside) else f"not ({any_row(outside.tolist())})"
        return MilvusScope(self, (few,), lambda entries: allowed[[entry.row for entry in entries]])


@dataclass(frozen=True, eq=False)
class Prior:
    """The known facts about a place that hold with some probability.

    constraints: on pose, time and sequence.
    tokens: of values that its metadata has.
    """

    constraints: tuple[Constraint, ...]
    tokens: tuple[str, ...]
    with_metadata: bool
    trust: float


def everything(entries: list[StoredPlace]) -> NDArray[np.bool_]:
    """All of some places; bool [n]."""
    return np.ones(len(entries), np.bool_)


@dataclass(frozen=True, eq=False)
class MilvusScope:
    """The places of a snapshot that a query may find (:class:`core.maps.store.Scope`).

    expressions: hold of these places, and maybe of others.
    keep: which of the places that Milvus finds by them belong to the scope.
    """

    snapshot: MilvusSnapshot
    expressions: tuple[str, ...] = ()
    keep: Keep = everything
    prior: Prior | None = None

    def search(self, descriptors: NDArray[np.float32]) -> list[Ranking]:
        """Rank the places of the scope by inner product, for each of the queries, float32 [B, D]."""
        rankings = self._ranked(descriptors, self.expressions, self.keep)
        if self.prior is None or len(self.snapshot) < COMPACT_FROM:
            return rankings
        bounds = filter(None, map(bounds_of, self.prior.constraints))
        favoured = (*self.expressions, *bounds, *with_tokens(self.prior.tokens))
        more = self._ranked(descriptors, favoured, self.keep)
        return [merged(ranking, other) for ranking, other in zip(rankings, more, strict=True)]

    def search_elsewhere(
        self, descriptor: NDArray[np.float32], ranking: Ranking, best: int, neighborhood: Neighborhood | None
    ) -> Ranking:
        """The best places that are neither in a ranking nor the same place as the row ``best``; no rows if none are."""
        (there,) = self.snapshot.entries_at(np.array([best]))
        listed = set(ranking[0].tolist())

        def keep(entries: list[StoredPlace]) -> NDArray[np.bool_]:
            matching = self.keep(entries) & np.array([entry.row not in listed for entry in entries], np.bool_)
            if neighborhood is None:
                return matching
            return matching & ~whereabouts_of([there, *entries]).near(0, neighborhood)[1:]

        expressions = [*self.expressions, f"not ({any_row([*listed, best])})"]
        where = whereabouts_of([there])
        # Within the cube in the ball of its neighbours, if no level, which Milvus does not know, may part them.
        if neighborhood is not None and where.kind[0] != NO_POSE and where.level[0] == NO_LEVEL:
            side = neighborhood.radius / 2
            inside = [
                f"{axis} >= {at - side!r} and {axis} <= {at + side!r}"
                for axis, at in zip("xyz", where.position[0].tolist(), strict=True)
            ]
            expressions.append(f"not (kind == {where.kind[0]} and {all_of(inside)})")
        return self._ranked(descriptor[np.newaxis], expressions, keep)[0]

    def living_rows(self) -> Rows:
        entries = self.snapshot.all_entries
        matching = [entry.row for entry, stays in zip(entries, self.keep(entries), strict=True) if stays]
        return np.array(sorted(matching), np.int64)

    def weights_at(self, rows: Rows) -> Values | None:
        """The log prior of rows, float64 [n]; None if there is no prior."""
        prior = self.prior
        if prior is None:
            return None
        entries = self.snapshot.entries_at(rows)
        where = whereabouts_of(entries)
        fits = [constraint.fit(where) for constraint in prior.constraints]
        if prior.with_metadata:
            wanted = set(prior.tokens)
            fits.append(np.array([wanted <= set(tokens_of(entry.place.metadata)) for entry in entries], np.float64))
        return log_weights(fits, min(prior.trust, LARGEST_TRUST))

    def _ranked(self, descriptors: NDArray[np.float32], expressions: Sequence[str], keep: Keep) -> list[Ranking]:
        """The best places that Milvus finds by expressions and ``keep`` keeps, by inner product, equal ones by row."""
        snapshot = self.snapshot
        queries = np.ascontiguousarray(descriptors, np.float32)
        if queries.ndim != 2 or queries.shape[1] != snapshot.state.record.dimension or not np.isfinite(queries).all():
            raise ValueError(f"a query is {snapshot.state.record.dimension} finite values")
        nothing: Ranking = np.empty(0, np.int64), np.empty(0, np.float32)
        if not len(queries) or not len(snapshot):
            return [nothing] * len(queries)
        wanted = len(snapshot) if len(snapshot) < COMPACT_FROM else SHORTLIST
        unused = (f"not (key in {list(snapshot.orphans)})",) if snapshot.orphans else ()
        bounds = f"row < {snapshot.rows}"
        expression = all_of((f"map == {snapshot.state.number}", bounds, *unused, *expressions))
        limit = min(MOST_FOUND, int(_SPARE * wanted) + 10)
        while True:
            snapshot.collection.expect(snapshot.state.collection)
            hits = snapshot.collection.search(queries, expression, limit, snapshot.state.recent)
            rankings = self._filtered(hits, keep)
            enough = all(
                len(keys) < limit or len(ranking[0]) >= wanted
                for (keys, _), ranking in zip(hits, rankings, strict=True)
            )
            if enough or limit == MOST_FOUND:
                return [(rows[:wanted], products[:wanted]) for rows, products in rankings]
            limit = min(MOST_FOUND, _MORE * limit)

    def _filtered(self, hits: Sequence[tuple[NDArray[np.int64], NDArray[np.float32]]], keep: Keep) -> list[Ranking]:
        """The rows of the keys that are places' of the scope."""
        snapshot = self.snapshot
        keys = np.unique(np.concatenate([found for found, _ in hits])).tolist()
        with snapshot.database.reading() as whole:
            entries = places.of_keys(MapConnection(whole, snapshot.state.number), keys)
        matching = [entry for entry, stays in zip(entries, keep(entries), strict=True) if stays] if entries else []
        snapshot.note(matching)
        rows = {entry.key: entry.row for entry in matching}
        rankings = []
        for found, products in hits:
            there = np.array([key in rows for key in found.tolist()], np.bool_)
            row = np.array([rows[key] for key in found[there].tolist()], np.int64)
            order = np.lexsort((row, -products[there]))
            rankings.append((row[order], products[there][order]))
        return rankings


def scope_of(connection: MapConnection, snapshot: MilvusSnapshot, selection: Selection | None) -> MilvusScope:
    """The places of a snapshot that a query may find by what its caller knows.

    Raises:
        MixedCoordinates: an area is given in coordinates that the places do not have.
    """
    whole = MilvusScope(snapshot)
    if not selection:
        return whole
    selection.check_coordinates(lambda kind: places.kinds_of_poses(connection, kind))
    filters = selection.filters
    constraints = _constraints(connection, filters)
    recent = selection.recent
    if recent is not None:
        code = sequences.find_code(connection, recent.sequence)
        if code is not None:
            oldest = sequences.oldest_of_last(connection, code, recent.frames) if recent.frames else None
            moment = recent.moment if recent.seconds else None
            constraints.append(NotLately(code, oldest, moment, round(1e6 * recent.seconds)))
    expressions = [bounds for constraint in constraints if (bounds := bounds_of(constraint)) is not None]
    tokens = wanted_tokens(filters.metadata)
    expressions += with_tokens(tokens)
    if selection.excluded is not None:
        rows = places.all_rows_of(connection, selection.excluded)
        expressions += [f"row not in {rows}"] if rows else []

    def keep(entries: list[StoredPlace]) -> NDArray[np.bool_]:
        wanted = set(tokens)
        has = [wanted <= set(tokens_of(entry.place.metadata)) for entry in entries]
        named = [place_and_look(entry.place.id)[0] != selection.excluded for entry in entries]
        return holding(constraints, whereabouts_of(entries)) & np.array(has, np.bool_) & np.array(named, np.bool_)

    prior = None
    if selection.prior:
        known = tuple(_constraints(connection, selection.prior)), tuple(wanted_tokens(selection.prior.metadata))
        prior = Prior(*known, bool(selection.prior.metadata), selection.trust)
    return replace(whole, expressions=tuple(expressions), keep=keep, prior=prior)


def _constraints(connection: MapConnection, conditions: Conditions) -> list[Constraint]:
    """The conditions on pose, time and sequence."""
    found = list(conditions.geometry)
    if conditions.sequences is not None:
        codes = sequences.codes_of(connection, conditions.sequences)
        found.insert(0, InSequences(tuple(codes.values())))
    return found
