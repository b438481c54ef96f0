"""A fixed script of every kind of write, in one process that goes on after each refusal and reports every outcome.

Every step is an operation of the storage layer beside its effect on the model (:mod:`tests.faults.model`).  The
outcome of a step is ``taken`` or the name of the error's class.  The report is written by ``writev``, into which no
fault is injected.
"""

from __future__ import annotations

import json
import os
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from core.storage.search import index_files

from core.errors import PlacerecError
from core.frames.masks import Mask
from core.maps import Correspondence, MapSettings
from core.places import PlaceFields
from core.store import Directory, Map
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame, keypoints_of
from tests.faults.model import State, all_told, best_of, place

MASK = Mask(polygons=(((0.0, 0.9), (1.0, 0.9), (1.0, 1.0), (0.0, 1.0)),))

Effect = Callable[[State], None]


@dataclass
class World:
    """The data directory; ``atlas`` is None while it is closed."""

    directory: Path
    atlas: Directory | None = None

    def open(self) -> None:
        """Open the directory, as a start of the service does."""
        if self.atlas is None:
            self.atlas = Directory(self.directory, rows_per_segment=4)

    def close(self) -> None:
        """Close the directory."""
        if self.atlas is not None:
            self.atlas.close()
        self.atlas = None

    def map(self, map_id: str) -> Map:
        """A map in service."""
        assert self.atlas is not None
        return self.atlas.get(map_id)


@dataclass(frozen=True)
class Step:
    """One operation.

    effect: on the model, when the operation succeeds.
    of_atlas: the operation writes nothing into the map "lab".
    is_whole: when it is refused, it has changed nothing; otherwise it may have happened completely all the same.
    """

    name: str
    act: Callable[[World], object]
    effect: Effect = field(default=lambda state: None)
    is_whole: bool = True
    of_atlas: bool = False


def _places(state: State, map_id: str = "lab") -> State:
    found: State = state[map_id]["places"]
    return found


def empty() -> State:
    """A new map."""
    return {"description": "", "index": "auto", "cameras": {}, "places": {}}


def _enrol(*names: str, map_id: str = "lab", shown: str | None = None, **fields: Any) -> Step:
    def act(world: World) -> object:
        return world.map(map_id).enrol([frame(name, shown or f"{name}!", **fields) for name in names])

    def effect(state: State) -> None:
        for name in names:
            _places(state, map_id)[name] = place(shown or f"{name}!", **fields)

    return Step(f"enrol {', '.join(names)}", act, effect)


def _move(world: World) -> object:
    fields = PlaceFields(sequence="tuesday", metadata={"floor": 2})
    return world.map("lab").set_fields("p1", fields)


def _enrol_without_keypoints(world: World) -> object:
    return world.map("lab").enrol([replace(frame("b0", "b0!", sequence="other"), keypoints=None)])


def _find_keypoints(world: World) -> object:
    lab = world.map("lab")
    found = [(one, keypoints_of("b0!")) for one in lab.without_keypoints(0, 9)]
    assert found, "no place lacks keypoints"
    return lab.add_keypoints(found)


def _align(world: World) -> None:
    lab = world.map("lab")
    row, other = lab.rows_of(["b0", "p3"])
    assert row is not None and other is not None
    where = lab.snapshot().whereabouts
    lab.counterparts.store(Correspondence({row: (int(where.sequence[other]), int(where.ordinal[other]))}))


def _forget_sequence(state: State) -> None:
    for name in [name for name, found in _places(state).items() if found["sequence"] == "monday"]:
        del _places(state)[name]


def _create(map_id: str, unlisted: bool = False) -> Callable[[World], object]:
    def act(world: World) -> object:
        assert world.atlas is not None
        if unlisted and map_id in world.atlas.unlisted():
            return world.atlas.unlisted()[map_id]
        return world.atlas.create(map_id, ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE, unlisted)

    return act


def _wait_for_codes(world: World) -> None:
    lab = world.map("lab")
    until = time.monotonic() + 60
    while lab.index_status().state != "ready" and time.monotonic() < until:
        time.sleep(0.002)


def _publish(world: World) -> object:
    assert world.atlas is not None
    if "hall" in {record.id for record in world.atlas.records(None, 100)[0]}:
        return None
    world.atlas.unlisted()["hall"].enrol([frame("h0", "h0!")])
    return world.atlas.publish("hall")


def _delete(world: World) -> None:
    assert world.atlas is not None
    world.atlas.delete("hall")


STEPS: tuple[Step, ...] = (
    Step("open", World.open, of_atlas=True),
    Step("create", _create("lab"), lambda state: state.update(lab=empty())),
    _enrol("p0", x=1.0),
    _enrol("p1", "p2", "p3", "p4", "p5", sequence="monday"),  # fills a segment and begins the next
    _enrol("p2", shown="other", sequence="monday"),
    Step("move", _move, lambda state: _places(state)["p1"].update(sequence="tuesday", metadata={"floor": 2})),
    Step(
        "patch",
        lambda world: world.map("lab").patch("p0", {"metadata": {"door": True}}),
        lambda state: _places(state)["p0"].update(metadata={"door": True}),
    ),
    Step(
        "enrol without keypoints",
        _enrol_without_keypoints,
        lambda state: _places(state).update(b0=place("b0!", keypoints=False, sequence="other")),
    ),
    Step(
        "find keypoints",
        _find_keypoints,
        lambda state: _places(state)["b0"].update(keypoints=place("b0!")["keypoints"]),
    ),
    Step("align", _align, lambda state: _places(state)["b0"].update(is_aligned=True)),
    Step(
        "camera",
        lambda world: world.map("lab").cameras.put("left", MASK),
        lambda state: state["lab"]["cameras"].update(left=True),
    ),
    Step(
        "edit",
        lambda world: world.map("lab").edit({"description": "the laboratory"}),
        lambda state: state["lab"].update(description="the laboratory"),
    ),
    Step("forget", lambda world: world.map("lab").forget("p4"), lambda state: _places(state).pop("p4")),
    Step("make another", _create("hall", unlisted=True), of_atlas=True),
    Step(
        "publish it",
        _publish,
        lambda state: state.update(hall={**empty(), "places": {"h0": place("h0!")}}),
        is_whole=False,
        of_atlas=True,
    ),
    Step("forget a sequence", lambda world: world.map("lab").forget_sequence("monday"), _forget_sequence),
    Step(
        "search by codes",
        lambda world: world.map("lab").edit({"index": "compact"}),
        lambda state: state["lab"].update(index="compact"),
    ),
    Step("wait for the index", _wait_for_codes),
    _enrol("q0", "q1", "q2", "q3", "q4", "q5", "q6", "q7", "q8"),
    Step("wait for the index again", _wait_for_codes),
    Step("delete", _delete, lambda state: state.pop("hall"), is_whole=False, of_atlas=True),
    Step("close", World.close, of_atlas=True),
    Step("open again", World.open, of_atlas=True),
    _enrol("late", sequence="wednesday"),
)

PLAIN = tuple(step for step in STEPS if "index" not in step.name and "codes" not in step.name)
"""The steps without codes, because measuring their recall takes long."""

AFTERWARDS = _enrol("afterwards")
"""Must succeed when the fault has passed, without a restart."""


def outcome_of(world: World, step: Step) -> str:
    """Do a step; ``taken``, or what went wrong."""
    try:
        step.act(world)
    except PlacerecError as error:
        return type(error).__name__
    except (KeyError, AssertionError) as error:
        return type(error).__name__
    except Exception:
        return "unexpected: " + traceback.format_exc()
    return "taken"


def run(directory: Path, go: Path, result: Path, indexed: bool) -> None:
    """Run the script as soon as the file ``go`` exists, and write the report to ``result``.

    After the steps the file ``passing`` is made beside ``go``, and the script waits for ``passed``; in between the
    faults are removed.

    Args:
        indexed: include the steps that make codes.
    """
    index_files.GROUP_ROWS = 4
    sink = os.open(result.with_suffix(".part"), os.O_WRONLY | os.O_CREAT, 0o644)
    _wait_for(go)
    world = World(directory)
    outcomes: list[str] = []
    for step in STEPS if indexed else PLAIN:
        outcomes.append(outcome_of(world, step))
        if outcomes[-1] != "taken" and step.name.startswith("open"):
            outcomes[-1] = outcome_of(world, step)  # a service that could not start is started again
    os.mkfifo(go.with_name("passing"))
    _wait_for(go.with_name("passed"))
    told: dict[str, Any] = {"outcomes": outcomes}
    try:
        told |= _afterwards(world)
    except Exception:
        told["unexpected"] = traceback.format_exc()
    os.writev(sink, [json.dumps(told).encode(), b"\n"])
    os.close(sink)
    result.with_suffix(".part").rename(result)


def _wait_for(path: Path) -> None:
    while not path.exists():
        time.sleep(0.001)


def _afterwards(world: World) -> dict[str, Any]:
    """The state in the same process, and whether writes succeed again."""
    world.open()
    assert world.atlas is not None
    for map_id in world.atlas.quarantined():  # one that the disk refused to open is tried again when it is asked for
        world.atlas.get(map_id)
    state = all_told(world.atlas)
    reports = {map_id: world.atlas.verify(map_id).problems for map_id in state}
    quarantined = world.atlas.quarantined()
    if "lab" not in state and not quarantined:
        _create("lab")(world)
    last = outcome_of(world, AFTERWARDS)
    best = None if quarantined else best_of(world.map("lab"), "afterwards!")
    world.close()
    return {"state": state, "problems": reports, "quarantined": quarantined, "last": last, "best": best}
