"""Texts are compared in one form of Unicode, however a request sends them."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any
from unicodedata import normalize

import pytest

from tests.service.places.test_batches import send
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem

CAFE = "Café"
APART = normalize("NFD", CAFE)
JPEG = {"Content-Type": "image/jpeg"}

Enrol = Callable[[Server, str, str], int]


def in_query(server: Server, map_id: str, name: str) -> int:
    return server.enrol(map_id, "p", jpeg(1), sequence=name, metadata={name: name}).status_code


def in_form(server: Server, map_id: str, name: str) -> int:
    fields = {"sequence": name, "metadata": json.dumps({name: name})}
    return server.client.put(
        f"/v1/maps/{map_id}/places/p", data=fields, files={"image": ("a.jpg", jpeg(1), "image/jpeg")}
    ).status_code


def in_batch(server: Server, map_id: str, name: str) -> int:
    place = {"id": "p", "file": name, "sequence": name, "metadata": {name: name}}
    return send(server, map_id, [place], {CAFE: jpeg(1)}).status_code


def in_patch(server: Server, map_id: str, name: str) -> int:
    server.enrol(map_id, "p", jpeg(1))
    changes = {"sequence": name, "metadata": {name: name}}
    return server.client.patch(f"/v1/maps/{map_id}/places/p", json=changes).status_code


@pytest.mark.parametrize("enrol", [in_query, in_form, in_batch, in_patch])
@pytest.mark.parametrize("name", [CAFE, APART], ids=["composed", "apart"])
def test_a_traverse_is_found_whatever_the_form_of_its_name(
    server: Server, map_id: str, enrol: Enrol, name: str
) -> None:
    assert enrol(server, map_id, name) < 300
    path = f"/v1/maps/{map_id}"
    place = server.client.get(f"{path}/places/p").json()
    assert (place["sequence"], place["metadata"]) == (CAFE, {CAFE: CAFE})
    for wanted in (CAFE, APART):
        for where in ({"sequence": wanted}, {"where": json.dumps({wanted: wanted})}):
            assert [one["id"] for one in server.client.get(f"{path}/places", params=where).json()["items"]] == ["p"]
        for given in (wanted, json.dumps([wanted])):
            assert server.query(map_id, jpeg(1), sequences=given)["matches"][0]["place"]["id"] == "p"
        filter_: dict[str, Any] = {"filter": {"sequence": wanted, "where": {wanted: wanted}}}
        assert server.client.post(f"{path}/places:delete", json=filter_).json()["ids"] == ["p"]
    other = APART if name == CAFE else CAFE
    assert server.client.post(f"{path}/sessions", json={"sequences": [other]}).status_code == 201
    assert server.client.delete(f"{path}/sequences/{other}").json()["places"] == 1


def test_names_that_look_the_same_are_one(server: Server, map_id: str) -> None:
    for place, name in (("p0", CAFE), ("p1", APART)):
        server.enrol(map_id, place, jpeg(int(place[1])), sequence=name).raise_for_status()
    (one,) = server.client.get(f"/v1/maps/{map_id}/sequences").json()["items"]
    assert (one["name"], one["places"]) == (CAFE, 2)
    twice = {"metadata": {CAFE: 1, APART: 2}}
    refused = server.client.patch(f"/v1/maps/{map_id}/places/p0", json=twice)
    assert "nothing that can be seen" in assert_problem(refused, 400, "malformed-body")["detail"]
    refused = server.enrol(map_id, "p2", jpeg(2), metadata=twice["metadata"])
    assert_problem(refused, 422, "invalid-request")
    refused = send(server, map_id, [{"id": "p3", "file": CAFE}], {CAFE: jpeg(3), APART: jpeg(4)})
    assert_problem(refused, 422, "invalid-request")


def test_what_is_no_text_is_answered(server: Server, map_id: str) -> None:
    for query in ("sequence=%ff", "sequence=%cc%81", "cursor=%zz"):
        assert server.client.get(f"/v1/maps/{map_id}/places?{query}").status_code in (200, 422)
