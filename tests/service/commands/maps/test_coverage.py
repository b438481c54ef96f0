"""``placerec maps coverage``."""

from __future__ import annotations

import json

import pytest

from tests.service.commands.conftest import Placerec
from tests.service.scenes import jpeg
from tests.service.server import Server


@pytest.mark.thorough
def test_whether_a_pose_is_in_a_map(placerec: Placerec, server: Server, map_id: str) -> None:
    url = ["--url", str(server.client.base_url)]

    def told(*words: str) -> str:
        return placerec("maps", "coverage", map_id, *words, *url).stdout

    assert "No place of the map has a pose." in told("--x", "0", "--y", "0")
    for number, x in enumerate((0, 1, 21)):
        server.enrol(map_id, f"p{number}", jpeg(number), x=x, y=0, heading=0, sequence="monday")
    covered = told("--x", "0.5", "--y", "0", "--heading", "10", "-k", "1")
    assert "The pose is in the map: 2 places within 5 m, the nearest at 0.50 m." in covered
    assert "They have 2 looks; their traverses: monday." in covered and "p0" in covered and "p1" not in covered
    assert "look elsewhere, at least 90° away" in told("--x", "0", "--y", "0", "--heading", "-90")
    assert "in a gap of 20.0 m between the places p1 and p2" in told("--x", "11", "--y", "0", "-k", "0")
    assert "nothing there; its nearest place is 100.0 m away" in told("--x", "0", "--y", "-100")
    assert json.loads(told("--x", "0", "--y", "0", "--json"))["state"] == "covered"
    refused = placerec("maps", "coverage", map_id, "--latitude", "1", "--longitude", "2", *url, status=1)
    assert "a map has one kind" in " ".join(refused.stderr.split())
