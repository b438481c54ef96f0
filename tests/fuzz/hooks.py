"""Tells schemathesis what a picture is, and the names of what exists in the service.

A random name leads to nothing, so a request whose path is meant to be valid is given one that exists.  Whatever such a
request deletes is put back, except in runs through links, which make what they need.
"""

from __future__ import annotations

import os
import uuid
from typing import Any

import httpx
import schemathesis
from hypothesis import strategies as st
from schemathesis import Case, HookContext, Response
from schemathesis.core.parameters import ParameterLocation
from schemathesis.generation.meta import TestPhase

from tests.fuzz.pictures.originals import originals
from tests.service.scenes import jpeg

MAP, OTHER_MAP, CAMERA, SEQUENCE, PLACES = "quay", "shed", "front", "monday", 3
MASK = {"mask": {"polygons": [[[0, 0.8], [1, 0.8], [1, 1], [0, 1]]]}}

for _name in ("jpeg", "png", "webp"):
    _files = [one.data for one in originals() if one.format == _name and "animated" not in one.name]
    schemathesis.openapi.media_type(f"image/{_name}", st.sampled_from(_files))


class Fixtures:
    """What exists in a service, and how to put it back."""

    def __init__(self, url: str) -> None:
        key = os.environ.get("PLACEREC_KEY")
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        self._client = httpx.Client(base_url=url, timeout=60, headers=headers)
        self.session = self.explanation = self.job = self.key = ""

    def put_back(self) -> None:
        """Make what is missing."""
        for map_id in (MAP, OTHER_MAP):
            if self._client.get(f"/v1/maps/{map_id}").status_code == 404:
                self._client.post("/v1/maps", json={"id": map_id, "keep": "image"})
            for number in range(PLACES):
                path = f"/v1/maps/{map_id}/places/p{number}"
                if self._client.get(path).status_code == 404:
                    where: dict[str, str | int] = {"x": 2 * number, "y": 0, "sequence": SEQUENCE}
                    self._client.put(path, params=where, content=jpeg(number), headers={"Content-Type": "image/jpeg"})
        if self._client.get(f"/v1/maps/{MAP}/cameras/{CAMERA}").status_code == 404:
            self._client.put(f"/v1/maps/{MAP}/cameras/{CAMERA}", json=MASK)
        if not self.session or self._client.get(f"/v1/maps/{MAP}/sessions/{self.session}").status_code != 200:
            self.session = self._client.post(f"/v1/maps/{MAP}/sessions", json={}).json().get("id", "")
        if not self.job or self._client.get(f"/v1/jobs/{self.job}").status_code != 200:
            self.job = self._client.post(f"/v1/maps/{OTHER_MAP}/prune", json={"dry_run": True}).json().get("id", "")

        if self._client.get(f"/v1/keys/{self.key or 'none'}").json().get("state") != "in force":
            new = {"name": f"spare-{uuid.uuid4()}", "role": "enrol"}
            self.key = self._client.post("/v1/keys", json=new).json().get("id", "")

    def names(self) -> dict[str, str]:
        """Path parameter -> a name that exists."""
        known = {"map": MAP, "place": "p1", "camera": CAMERA, "sequence": SEQUENCE, "session": self.session}
        return {name: value for name, value in (known | {"job": self.job, "key": self.key}).items() if value}


_fixtures: dict[str, Fixtures] = {}
_DELETES = (
    "delete_map",
    "delete_place",
    "delete_sequence",
    "delete_camera",
    "delete_session",
    "prune_map",
    "delete_key",
)


def _of(case: Case[Any]) -> Fixtures:
    url = str(case.operation.base_url)
    if url not in _fixtures:
        _fixtures[url] = Fixtures(url)
        _fixtures[url].put_back()
    return _fixtures[url]


def _through_links(case: Case[Any]) -> bool:
    return case.meta is not None and case.meta.phase.name == TestPhase.STATEFUL


@schemathesis.hook
def before_call(context: HookContext, case: Case[Any], kwargs: dict[str, Any]) -> None:
    """Give a request whose path is meant to be valid names that exist."""
    if case.meta is None or _through_links(case) or not case.path_parameters:
        return
    path = case.meta.components.get(ParameterLocation.PATH)
    if path is not None and path.mode.is_positive:
        names = _of(case).names()
        case.path_parameters = {name: names.get(name, value) for name, value in case.path_parameters.items()}


@schemathesis.hook
def after_call(context: HookContext, case: Case[Any], response: Response) -> None:
    """Put back what a request deleted."""
    operation = case.operation.definition.raw.get("operationId")
    if operation in _DELETES and response.status_code < 300 and not _through_links(case):
        _of(case).put_back()
