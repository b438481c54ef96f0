"""A large map has its codes in a real Milvus, which may lose them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from core.index import CodeTable
from core.store import Directory, Map, following
from core.store.snapshot import SHORTLIST
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame
from tests.service.wire import eventually

if TYPE_CHECKING:
    from core.index.milvus import Milvus

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


@pytest.fixture
def milvus() -> Iterator[Milvus]:
    from core.index.milvus import Milvus
    from tests.servers.milvus import running_milvus

    with running_milvus() as server:
        milvus = Milvus(server.address)
        yield milvus
        milvus.close()


def in_milvus(lab: Map, behind: int = following.MOST_BEHIND) -> bool:
    """Whether the codes of a map are in Milvus, but for a few of the last."""
    lab.snapshot()
    held = lab._followed.held
    assert held is not None
    table = held.snapshot.table
    return table is not None and not isinstance(table, CodeTable) and len(table) > held.snapshot.rows - behind


def first_of(lab: Map, place_id: str) -> str | None:
    """The place that a map finds first by what a place shows."""
    rows, _ = lab.snapshot().search(descriptor_of(place_id))
    found = lab.places_at(rows[:1].tolist())[0]
    return None if found is None else found.id


def test_a_map_is_searched_by_milvus_and_by_memory_when_that_lost_it(
    tmp_path: Path, milvus: Milvus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "IN_MILVUS_FROM", 300)
    store = Directory(tmp_path / "data", milvus=milvus)
    lab = store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    lab.enrol([frame(f"p{number}") for number in range(400)])
    assert eventually(lambda: in_milvus(lab), 120)
    assert lab.snapshot().coded == 400 and lab.index_status().tier == "compact"
    wanted = [f"p{number}" for number in range(0, 400, 37)]
    assert [first_of(lab, one) for one in wanted] == wanted
    assert len(lab.snapshot().search(descriptor_of("p1"))[0]) == SHORTLIST

    lab.enrol([frame(f"q{number}") for number in range(100)])  # compared one by one until Milvus has them
    lab.forget("p37")
    assert first_of(lab, "q99") == "q99" and first_of(lab, "p37") != "p37"
    assert eventually(lambda: in_milvus(lab) and lab.snapshot().coded == 500, 120)
    assert first_of(lab, "q99") == "q99" and first_of(lab, "p37") != "p37"
    lab.erase()
    assert eventually(lambda: in_milvus(lab), 120)
    few = np.zeros(500, np.bool_)
    few[[3, 450]] = True
    assert sorted(lab.snapshot().search(descriptor_of("p3"), few)[0].tolist()) == [3, 450]

    assert milvus.drop(lambda uid: uid == following.uid_of(lab.record)) == 1
    assert eventually(lambda: searched(lab) and in_milvus(lab), 120)
    assert [first_of(lab, one) for one in ("p3", "q50")] == ["p3", "q50"]

    store.delete("lab")
    assert milvus.drop(lambda _uid: True) == 0
    store.close()


def searched(lab: Map) -> bool:
    """Whether a map can be searched; the search that finds its codes lost fails, and the next ones need not."""
    from core.errors import StoreUnavailable

    try:
        return first_of(lab, "p3") == "p3"
    except StoreUnavailable:
        return False
