from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np

from lab.evaluation.report.thumbnails import LONGEST, Thumbnails
from tests.lab.evaluation.report.comparisons import Written, write_images


def test_an_image_is_stored_once_and_small(tmp_path: Path) -> None:
    large = tmp_path / "large.png"
    large.write_bytes(cv2.imencode(".png", np.full((600, 1200, 3), (250, 120, 10), np.uint8))[1].tobytes())
    thumbnails = Thumbnails()
    first = thumbnails.add(large)
    assert first is not None
    assert thumbnails.add(large) is first
    assert (first.width, first.height) == (LONGEST, LONGEST // 2)
    assert thumbnails.retained == [first]
    data = base64.b64decode(first.address.removeprefix("data:image/jpeg;base64,"))
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded.shape == (LONGEST // 2, LONGEST, 3)
    assert np.abs(decoded.astype(int) - (250, 120, 10)).max() < 8


def test_budget_is_spent(tmp_path: Path) -> None:
    paths = write_images(tmp_path, 2)
    thumbnails = Thumbnails(budget=1000)
    assert not thumbnails.full
    thumbnails.add(paths[0])
    left = thumbnails.left
    assert left < 1000
    thumbnails.add(paths[0])
    assert thumbnails.left == left
    while not thumbnails.full:
        thumbnails.add(write_images(tmp_path / str(thumbnails.left), 1)[0])


def test_what_is_no_image(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("not an image")
    thumbnails = Thumbnails()
    assert thumbnails.add(tmp_path / "text.png") is None
    assert thumbnails.add(tmp_path / "missing.png") is None
    assert thumbnails.retained == []


def test_each_is_stored_once_and_shown_by_its_id(written: Written) -> None:
    page = written.page
    stored = [str(image.attributes["id"]) for image in page.named("image")]
    shown = [str(use.attributes["href"]) for use in page.named("use") if "href" in use.attributes]
    assert 0 < len(stored) == len(set(stored)) < len(shown)
    assert {f"#{id}" for id in stored} == set(shown)
