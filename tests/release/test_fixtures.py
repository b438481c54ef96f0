"""An export of every release is imported.  A data directory is read, with the answers that there were, by the versions
that know its form; any other version refuses it, and says what to do.

The code as it stands makes fixtures of its own, which are held to the same as those of a release.
"""

from __future__ import annotations

import copy
import hashlib
import json
import lzma
import os
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from core.store.directory import EARLIER, FORMAT
from placerec_client import Client
from tests.release import furnishing
from tests.release.conversation import Replay, read
from tests.release.furnishing import (
    ABOUT,
    ARCHIVE,
    CONVERSATION,
    FIXTURES,
    INTERFACE,
    SURFACE,
    again,
    forms,
    serving,
    unpacked,
)  # fmt: skip
from tests.release.surface import broken, interface, missing
from tests.service.server import ROOT, Server

GONE = [
    "metrics: placerec_indexes_building",
    *(
        f"settings: objects{part}"
        for part in ("", "_access_key", "_certificate", "_endpoint", "_region", "_secret_key")
    ),
    *(f"settings: ray{part}" for part in ("", "_address", "_batch", "_max_replicas", "_replica_cpus", "_replica_gpus")),
    *(f"settings: ray{part}" for part in ("_replicas", "_scale_seconds")),
    *(f"commands: placerec ray {words}" for words in ("deploy", "deploy --address", "deploy --timeout", "start")),
    *(f"commands: placerec ray {words}" for words in ("status", "status --address")),
    "commands: placerec serve --ray",
]
"""The names of 1.0 that 2.0 does not have."""

GONE_FROM_INTERFACE = ["IndexStatus has no problem", "IndexStatus has no progress"]
"""What 2.0 does not say any more: no index is built in the background."""

RELEASES = sorted(path for path in FIXTURES.iterdir() if path.is_dir())


def about(release: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((release / ABOUT).read_text())
    return found


@pytest.fixture(params=RELEASES, ids=lambda path: path.name)
def release(request: pytest.FixtureRequest) -> Path:
    found: Path = request.param
    return found


READ = [path for path in RELEASES if about(path)["format"] == FORMAT]
REFUSED = [path for path in RELEASES if about(path)["format"] != FORMAT]


@pytest.fixture(scope="module")
def today(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fixtures of the code as it stands."""
    return furnishing.write("today", tmp_path_factory.mktemp("fixtures"))


@pytest.fixture(params=[*READ, None], ids=lambda path: "today" if path is None else path.name)
def readable(request: pytest.FixtureRequest) -> Path:
    """Fixtures whose data directory is read."""
    found: Path = request.param or request.getfixturevalue("today")
    return found


@pytest.fixture
def running(readable: Path, tmp_path: Path) -> Iterator[Server]:
    """Today's service on the data directory of a release."""
    with serving(unpacked(readable, tmp_path), tmp_path / "service", about(readable)["key"]) as found:
        yield found


def test_there_are_fixtures_and_they_are_whole() -> None:
    assert RELEASES
    for release in RELEASES:
        digests = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in release.iterdir()}
        del digests[ABOUT]
        assert about(release)["sha256"] == digests and about(release)["version"] == release.name
        assert sum(path.stat().st_size for path in release.iterdir()) < 3e6


@pytest.mark.thorough
def test_the_data_opens_and_the_client_s_requests_are_answered_as_they_were(running: Server, readable: Path) -> None:
    exchanges = read((readable / CONVERSATION).read_text())
    assert len(exchanges) > 30
    running.client.headers.pop("Authorization")  # the key is among what was recorded
    assert list(Replay(running.client).differences(exchanges)) == []
    assert running.lines(level="error") == [], "something of the data was put aside"


@pytest.mark.thorough
def test_an_export_is_imported_and_answers_as_its_map_did(release: Path, tmp_path: Path) -> None:
    service = Server(tmp_path / "new").wait()
    with Client(str(service.client.base_url)) as client:
        assert client.maps.import_(release / ARCHIVE, id="copy").wait().state == "succeeded"
        copy = client.maps["copy"]
        assert copy.verify().ok and copy.read().description == "a hall"
        assert [one.id for one in copy.places.list()] == ["p0", "p1", "p2", "p3"] and list(copy.places.looks("p1"))
        for number in range(4):
            answer = copy.query(again(number))
            assert (answer.verdict, answer.place and answer.place.id) == ("recognized", f"p{number}")
    assert service.stop() == 0


@pytest.mark.thorough
@pytest.mark.parametrize("refused", REFUSED, ids=lambda path: path.name)
def test_the_data_of_an_earlier_form_is_refused_with_the_way_to_go_on(refused: Path, tmp_path: Path) -> None:
    data = unpacked(refused, tmp_path)
    before = contents(data)
    said = refusal(data, tmp_path / "service", about(refused)["key"])
    assert "export its maps with that version, and import the files into a new data directory" in said
    assert "Traceback" not in said and contents(data) == before


def released_interface(release: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(lzma.decompress((release / INTERFACE).read_bytes()))
    return found


def test_nothing_of_an_earlier_interface_is_missing(release: Path) -> None:
    """docs/reference/compatibility.md promises it."""
    assert list(broken(released_interface(release), interface())) == GONE_FROM_INTERFACE


@pytest.mark.thorough
def test_no_name_of_an_earlier_version_is_missing(release: Path, today: Path) -> None:
    now = json.loads((today / SURFACE).read_text())
    assert missing(json.loads((release / SURFACE).read_text()), now) == GONE
    assert missing({"settings": ["host", "colour"]}, now) == ["settings: colour"]


@pytest.mark.parametrize(
    ("path", "key", "sentence"),
    [
        (("paths",), "/v1/maps", "GET /v1/maps is gone"),
        (("paths", "/v1/maps"), "post", "POST /v1/maps is gone"),
        (("paths", "/v1/maps", "get", "responses"), "200", "GET /v1/maps: the status 200 is gone"),
        (("components", "schemas", "MapView", "properties"), "keep", "MapView has no keep"),
        (("components", "schemas", "MapView"), "required", "MapView may lack id"),
    ],
)
def test_what_an_interface_takes_away_is_found(path: tuple[str, ...], key: str, sentence: str) -> None:
    changed = copy.deepcopy(interface())
    part = changed
    for name in path:
        part = part[name]
    del part[key]
    assert sentence in list(broken(interface(), changed))


def test_what_an_interface_comes_to_demand_is_found() -> None:
    changed = copy.deepcopy(interface())
    parameter = {"in": "query", "name": "colour", "required": True}
    changed["paths"]["/v1/maps"]["get"].setdefault("parameters", []).append(parameter)
    changed["components"]["schemas"]["NewMap"]["required"].append("colour")
    found = list(broken(interface(), changed))
    assert "GET /v1/maps: the parameter colour must be given" in found and "NewMap must have colour" in found


def test_a_changed_form_of_a_file_is_a_changed_form_of_the_directory() -> None:
    """So that every older version refuses the whole of it at once, instead of putting files aside that it cannot read.

    A version that changes the schema of a file gives the directory another FORMAT, which it writes before it brings
    the first file up to date.
    """
    for release in RELEASES:
        of = about(release)
        assert of["format"] in (FORMAT, *EARLIER)
        assert (of["forms"] == forms()) == (of["format"] == FORMAT), f"the data of {release.name} has another form"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refusal(data: Path, folder: Path, key: str) -> str:
    """What a service says that does not start on a data directory."""
    service = Server(folder, {**furnishing.FOREVER, "data_dir": data}, key=key)
    assert service.process.wait(120) not in (0, None)
    service.client.close()
    service.reservation.close()
    return service.log_file.read_text()


@pytest.mark.thorough
def test_the_data_of_a_later_version_is_refused_and_left_as_it_is(readable: Path, tmp_path: Path) -> None:
    data = unpacked(readable, tmp_path)
    (data / "FORMAT").write_text("placerec data 99\n")
    before = contents(data)
    said = refusal(data, tmp_path / "service", about(readable)["key"])
    assert "was written by a later version of placerec (placerec data 99)" in said and "Traceback" not in said
    assert contents(data) == before


@pytest.mark.thorough
@pytest.mark.parametrize("file", ["maps/hall/map.sqlite", "jobs.sqlite", "keys.sqlite"])
def test_a_file_of_a_later_version_is_refused_and_left_as_it_is(file: str, today: Path, tmp_path: Path) -> None:
    data = unpacked(today, tmp_path)
    with closing(sqlite3.connect(data / file)) as connection:
        connection.execute("PRAGMA user_version = 99")
        connection.execute("CREATE TABLE later (one INTEGER)")
    kept = (data / file).read_bytes()
    said = refusal(data, tmp_path / "service", about(today)["key"])
    assert "was written by a later version of placerec (schema 99, this one knows" in said
    assert (data / file).read_bytes() == kept and not list(data.rglob("*.damaged-*"))


def test_fixtures_of_a_released_version_stay(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True)

    git("init")
    git("commit", "--allow-empty", "--message", "one")
    git("tag", "v9.9.9")
    command = [str(ROOT / "scripts/fixtures"), "9.9.9"]
    there = {**os.environ, "GIT_DIR": str(tmp_path / ".git")}
    done = subprocess.run(command, env=there, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "Version 9.9.9 is released" in done.stderr
