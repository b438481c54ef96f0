"""Which frames of a traverse show one view."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from core.maps.views import ABOUT, SAME, LatestViews, ViewedFrame, latest_views, likeness, shows_same
from core.places import Pose

CELLS, VALUES = 40, 24
NO_CELLS = np.empty((0, 0), np.int8)


def cells(seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(0, 30, (CELLS, VALUES))


def look(seen: NDArray[np.float64], noise: float = 0.0, seed: int = 0) -> ViewedFrame:
    noisy = seen + np.random.default_rng(seed).normal(0, noise, seen.shape) if noise else seen
    return ViewedFrame(np.ones(4, np.float32), np.clip(np.rint(noisy), -127, 127).astype(np.int8))


def between(one: int, other: int, share: float) -> NDArray[np.float64]:
    """A view on the way from one to another."""
    return np.sqrt(1 - share) * cells(one) + np.sqrt(share) * cells(other)


def positions(looks: list[ViewedFrame], hidden: int = 3) -> list[int]:
    """The positions that the frames of a traverse get."""
    views, found, end = LatestViews(None, {}, hidden), [], 0
    for one in looks:
        at = views.position_of(one)
        at, end = (end, end + 1) if at is None else (at, end)
        views.note(at, one)
        found.append(at)
    return found


def test_noise_changes_the_likeness_hardly_and_another_view_has_none() -> None:
    assert likeness(look(cells(1), 5, 1).local, look(cells(1), 5, 2).local) > 0.95
    assert abs(likeness(look(cells(1)).local, look(cells(2)).local)) < 0.1


def test_what_all_cells_of_a_frame_share_does_not_make_it_alike() -> None:
    tint = np.full(VALUES, 60.0)
    assert abs(likeness(look(cells(1) + tint).local, look(cells(2) + tint).local)) < 0.1


def test_hidden_cells_do_not_count() -> None:
    whole = look(cells(1), 3, 1).local
    part = look(cells(1), 3, 2).local.copy()
    part[: CELLS // 2] = 0
    assert likeness(whole, part) > 0.95
    assert likeness(whole, np.zeros_like(whole)) == 0.0


def test_without_cells_descriptors_tell() -> None:
    one, near, far = (ViewedFrame(np.array(values, np.float32), NO_CELLS) for values in ([1, 0], [1, 0.2], [0.3, 1]))
    assert shows_same(one, near)
    assert not shows_same(one, far, about=True)


def test_a_robot_that_stands_is_at_one_position() -> None:
    stop = [look(cells(2), 4, seed) for seed in range(50)]
    assert positions([look(cells(1)), *stop, look(cells(3))]) == [0, *[1] * 50, 2]


def test_people_who_pass_hide_no_stop() -> None:
    stop = cells(2)
    looks = []
    for number in range(20):
        passed = stop.copy()
        if number % 2:  # another one each time, before other cells
            start = number % 5 * 5
            passed[start : start + 15] = cells(100 + number)[:15]
        looks.append(look(passed, 2, number))
    assert likeness(looks[0].local, looks[1].local) < ABOUT
    assert positions([look(cells(1)), *looks, look(cells(3))]) == [0, *[1] * 20, 2]


@pytest.mark.parametrize(("between_them", "expected"), [(2, [0, 1, 2, 0]), (4, [0, 1, 2, 3, 4, 5])])
def test_a_view_may_be_hidden_for_a_moment_only(between_them: int, expected: list[int]) -> None:
    others = [look(cells(10 + number)) for number in range(between_them)]
    assert positions([look(cells(1)), *others, look(cells(1), 4, 7)]) == expected


def test_a_fast_camera_makes_a_new_view_when_the_first_one_is_left() -> None:
    walk = [look(between(1, 2, share), 2, number) for number, share in enumerate(np.linspace(0, 1, 60))]
    found = positions(walk)
    assert found == sorted(found)
    assert 2 <= found[-1] < 10
    for position in set(found):
        first = walk[found.index(position)]
        assert all(
            likeness(first.local, one.local) >= ABOUT - 1e-6
            for one, at in zip(walk, found, strict=True)
            if at == position
        )


def test_frames_that_are_only_about_the_same_are_apart() -> None:
    one, other = look(cells(1)), look(between(1, 2, 0.25))
    assert ABOUT < likeness(one.local, other.local) < SAME
    assert positions([one, other]) == [0, 1]


def test_the_end_of_a_sequence_is_read_by_row() -> None:
    kept = {3: look(cells(1)), 8: look(cells(2)), 9: look(cells(2), 4, 1)}
    views = latest_views((6, 9), {5: 3, 6: 8}, 3, 15.0, lambda rows: [kept[row] for row in rows])
    assert views.position_of(look(cells(2), 4, 2)) == 6
    assert views.position_of(look(cells(1), 4, 2)) == 5
    assert views.position_of(look(cells(3))) is None
    assert latest_views(None, {}, 3, 15.0, lambda rows: []).position_of(look(cells(1))) is None


def test_poses_decide_before_looks_do() -> None:
    def at(x: float | None) -> ViewedFrame:
        return dataclasses.replace(look(cells(1)), pose=None if x is None else Pose(x=x, y=0.0))

    views = LatestViews((4, at(0.0)), {3: at(100.0), 4: at(0.0)}, 3, 15.0)
    assert [views.position_of(at(x)) for x in (15.0, 16.0, 90.0, None)] == [4, None, 3, 4]
    geographic = dataclasses.replace(at(None), pose=Pose(latitude=50.0, longitude=7.0))
    assert views.position_of(geographic) == 4, "poses of two kinds tell nothing"
