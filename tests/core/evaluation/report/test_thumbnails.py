from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np

from core.evaluation.report.thumbnails import LONGEST, Thumbnails, show
from tests.core.evaluation.report.comparisons import read_page, write_images


def test_an_image_is_kept_once_and_small(tmp_path: Path) -> None:
    large = tmp_path / "large.png"
    large.write_bytes(cv2.imencode(".png", np.full((600, 1200, 3), (250, 120, 10), np.uint8))[1].tobytes())
    thumbnails = Thumbnails()
    first = thumbnails.add(large)
    assert first is not None
    assert thumbnails.add(large) is first
    assert (first.width, first.height) == (LONGEST, LONGEST // 2)
    page = read_page(thumbnails.definitions())
    (image,) = page.named("image")
    assert image.attributes["id"] == first.id
    data = base64.b64decode(str(image.attributes["href"]).removeprefix("data:image/jpeg;base64,"))
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
    assert not read_page(thumbnails.definitions()).named("image")


def test_boxes_are_fractions(tmp_path: Path) -> None:
    thumbnail = Thumbnails().add(write_images(tmp_path, 1)[0])
    assert thumbnail is not None
    html = show(thumbnail, 'a "name"', [(0.0, 0.5, 0.25, 1.0)])
    page = read_page(html)
    assert page.named("svg")[0].attributes["aria-label"] == 'a "name"'
    assert page.named("use")[0].attributes["href"] == f"#{thumbnail.id}"
    assert page.named("rect")[0].attributes == {"x": "0.0", "y": "18.0", "width": "12.0", "height": "18.0"}
    assert not re.search("<g", show(thumbnail, ""))
