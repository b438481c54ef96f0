"""Any history of writes, restarts among them, against a model in memory."""

from __future__ import annotations

import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from core.errors import UnknownPlace, UnknownSequence
from core.places import PlaceFields, Pose
from core.store import Directory
from tests.core.store.frames import (
    DIMENSION,
    ENCODER,
    LOCAL_SHAPE,
    descriptor_of,
    digest_of,
    frame,
    local_of,
    stored_of,
)

IDS = st.sampled_from([f"p{i}" for i in range(7)])
PICTURES = st.sampled_from([f"picture {i}" for i in range(5)])
SEQUENCES = st.sampled_from([None, "a", "b"])
POSITIONS = st.sampled_from([None, 0.0, 1.0])


@dataclass
class Known:
    picture: str
    x: float | None
    sequence: str | None
    number: int


class MapHistory(RuleBasedStateMachine):
    @initialize()
    def start(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="placerec-history-"))
        self.atlas = Directory(self.folder / "data", rows_per_segment=3)
        self.lab = self.atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        self.model: dict[str, Known] = {}
        self.count = 0

    def teardown(self) -> None:
        if hasattr(self, "atlas"):
            deadline = time.monotonic() + 60
            while self.lab.index_status().state == "building":
                assert time.monotonic() < deadline
                time.sleep(0.002)
            assert self.lab.index_status().tier == self.lab.index_status().wanted
            self.agrees()
            report = self.lab.verify()
            assert report.ok, report.problems
            assert report.stale_caches == []
            self.atlas.close()
            shutil.rmtree(self.folder)

    @rule(items=st.lists(st.tuples(IDS, PICTURES, POSITIONS, SEQUENCES), min_size=1, max_size=5))
    def enrol(self, items: list[tuple[str, str, float | None, str | None]]) -> None:
        expected = []
        for place_id, picture, x, sequence in items:
            before = self.model.get(place_id)
            if before is None:
                self.count += 1
                expected.append("created")
            elif before.picture != picture:
                expected.append("replaced")
            else:
                expected.append("unchanged" if (before.x, before.sequence) == (x, sequence) else "updated")
            number = before.number if before else self.count
            self.model[place_id] = Known(picture, x, sequence, number)
        done = self.lab.enrol([frame(name, picture, x=x, sequence=sequence) for name, picture, x, sequence in items])
        assert [change for _, change in done] == expected
        assert [place.id for place, _ in done] == [name for name, *_ in items]

    @rule(place_id=IDS, x=POSITIONS, sequence=SEQUENCES)
    def set_fields(self, place_id: str, x: float | None, sequence: str | None) -> None:
        fields = PlaceFields(pose=None if x is None else Pose(x=x, y=0), sequence=sequence)
        known = self.model.get(place_id)
        if known is None:
            try:
                self.lab.set_fields(place_id, fields)
                raise AssertionError
            except UnknownPlace:
                return
        same = (known.x, known.sequence) == (x, sequence)
        assert self.lab.set_fields(place_id, fields)[1] == ("unchanged" if same else "updated")
        known.x, known.sequence = x, sequence

    @rule(place_id=IDS, sequence=SEQUENCES)
    def patch_sequence(self, place_id: str, sequence: str | None) -> None:
        if place_id in self.model:
            assert self.lab.patch(place_id, {"sequence": sequence}).sequence == sequence
            self.model[place_id].sequence = sequence

    @rule(place_id=IDS)
    def forget(self, place_id: str) -> None:
        try:
            self.lab.forget(place_id)
            assert place_id in self.model
            del self.model[place_id]
        except UnknownPlace:
            assert place_id not in self.model

    @rule(name=st.sampled_from(["a", "b"]))
    def forget_sequence(self, name: str) -> None:
        members = [place_id for place_id, known in self.model.items() if known.sequence == name]
        try:
            assert self.lab.forget_sequence(name) == len(members) > 0
        except UnknownSequence:
            assert not members
        for place_id in members:
            del self.model[place_id]

    @rule(setting=st.sampled_from(["exact", "compact"]))
    def search_otherwise(self, setting: str) -> None:
        """The index is built while the history goes on."""
        assert self.lab.edit({"index": setting}).index == setting

    @rule()
    def restart(self) -> None:
        self.atlas.close()
        self.atlas = Directory(self.folder / "data", rows_per_segment=3)
        self.lab = self.atlas.get("lab")

    @invariant()
    def agrees(self) -> None:
        if not hasattr(self, "lab"):
            return
        in_order = sorted(self.model, key=lambda place_id: self.model[place_id].number)
        assert [place.id for place in self.lab.places(None, 100)[0]] == in_order
        counts: dict[str, int] = {}
        for known in self.model.values():
            if known.sequence is not None:
                counts[known.sequence] = counts.get(known.sequence, 0) + 1
        summaries = self.lab.sequences(None, 100)[0]
        assert [(each.name, each.places) for each in summaries] == sorted(counts.items())

        snapshot = self.lab.snapshot()
        query = descriptor_of("query")
        rows, products = snapshot.search(query)
        found = self.lab.places_at(rows.tolist())
        assert len(snapshot) == len(rows) == len(self.model)
        assert sorted(place.id for place in found if place) == sorted(self.model)
        there, local = snapshot.whereabouts.take(rows), snapshot.locals_at(rows)
        for i, place in enumerate(found):
            assert place is not None
            known = self.model[place.id]
            np.testing.assert_array_equal(local[i], local_of(known.picture))
            assert abs(products[i] - float(stored_of(known.picture) @ query)) < 1e-5
            assert self.lab.digest(place.id) == digest_of(known.picture)
            assert (place.pose.x if place.pose else None, place.sequence) == (known.x, known.sequence)
            assert there.kind[i] == (known.x is not None)
            assert there.position[i, 0] == (known.x or 0.0)
        assert np.all(np.diff(products) <= 0)


TestMapHistory = MapHistory.TestCase
TestMapHistory.settings = settings(max_examples=25, stateful_step_count=20)
