"""What every store that several services share keeps to while they write to one map."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from core.errors import RevisionMismatch
from core.maps import PlaceFilter
from core.maps.views import ViewedFrame, shows_same
from core.store import Store
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame, local_of

BATCHES = 8


def check_writers_lose_nothing(store: Store, others: Sequence[Store]) -> None:
    """Several clients write to the map ``lab`` at the same time: every write counts, and edits exclude one another."""
    store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)

    def write(which: int) -> int:
        lab, refused = others[which].get("lab"), 0
        for number in range(BATCHES):
            lab.enrol([frame(f"w{which}-{number}", sequence="shared"), frame("both", f"by {which} {number}")])
            try:
                lab.edit({"description": f"by {which} {number}"}, lab.record.revision)
            except RevisionMismatch:
                refused += 1
        return refused

    writers = range(len(others))
    with ThreadPoolExecutor(len(others)) as pool:
        refused = sum(pool.map(write, writers))
    lab = store.get("lab")
    listed, _ = lab.places(None, 100, PlaceFilter(sequence="shared"))
    assert {place.id for place in listed} == {f"w{which}-{number}" for which in writers for number in range(BATCHES)}
    outline = lab.transfer.outline()
    first: dict[int, ViewedFrame] = {}  # what the first frame at each position shows; other frames there show it, too
    for place in sorted((place for place in outline if place.sequence == "shared"), key=lambda place: place.ordinal):
        look = ViewedFrame(descriptor_of(place.id), local_of(place.id))
        assert place.ordinal == len(first) or shows_same(look, first[place.ordinal], about=True)
        first.setdefault(place.ordinal, look)
    written = BATCHES * len(others)
    assert len(first) > 2 * written / 3
    assert lab.count_places() == written + 1 and lab.record.revision == 1 + written - refused
    for name in ("w0-0", f"w{len(others) - 1}-7"):
        ((rows, _),) = lab.scope().search(descriptor_of(name)[np.newaxis])
        assert lab.places_at(rows[:1].tolist())[0] == lab.place(name)
