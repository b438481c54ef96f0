"""Content negotiation."""

from __future__ import annotations

import pytest

from service.http.negotiation import preferred


@pytest.mark.parametrize(
    ("accept", "chosen"),
    [
        (None, "application/json"),
        ("", "application/json"),
        ("*/*", "application/json"),
        ("image/png", "image/png"),
        ("image/*", "image/png"),
        ("application/json, image/png", "application/json"),
        ("application/json;q=0.5, image/png", "image/png"),
        ("image/png;q=0.2, */*;q=0.9", "application/json"),
        ("image/png;q=0", "application/json"),
        ("text/html", "application/json"),
        ("IMAGE/PNG; q=nonsense", "application/json"),
        ("image/png; q=1.0 , application/json;q=0.9", "image/png"),
    ],
)
def test_what_a_caller_likes_best(accept: str | None, chosen: str) -> None:
    assert preferred(accept, "application/json", "image/png") == chosen
