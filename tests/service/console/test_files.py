"""The console's files: what is sent, under which policy, and where it comes from."""

from __future__ import annotations

import gzip
import hashlib
import json
import posixpath
import re
import tomllib
from pathlib import Path

import httpx
import pytest

from service.console import files
from service.console.files import FOLDER, console_files
from tests.service.server import Server, assert_problem

ROOT = Path(__file__).parents[3]
OWN = sorted(path for path in FOLDER.rglob("*.js") if "vendor" not in path.parts)
VENDOR = FOLDER / "vendor"


def test_the_page_loads_only_files_that_are_there(client: httpx.Client) -> None:
    page = client.get("/console")
    assert page.status_code == 200 and page.headers["content-type"] == "text/html; charset=utf-8"
    named = re.findall(r'(?:src|href)="([^"]*)"', page.text)
    assert len(named) > 10
    for address in named:
        assert address.startswith(f"console/{console_files().build}/")
        assert client.get(f"/{address}").status_code == 200, address


def test_whoever_types_a_slash_is_shown_the_page(client: httpx.Client) -> None:
    answer = client.get("/console/")
    assert answer.status_code == 308 and answer.headers["location"] == "../console"
    assert client.get("/console/", follow_redirects=True).text == client.get("/console").text


@pytest.mark.parametrize("path", ["/console", "/console/{build}/start.js", "/console/{build}/style.css"])
def test_every_answer_has_the_policy(client: httpx.Client, path: str) -> None:
    answer = client.get(path.format(build=console_files().build))
    rules = dict(rule.split(maxsplit=1) for rule in answer.headers["content-security-policy"].split("; "))
    assert rules["default-src"] == rules["script-src"] == rules["style-src"] == rules["connect-src"] == "'self'"
    assert rules["frame-ancestors"] == rules["base-uri"] == rules["form-action"] == rules["object-src"] == "'none'"
    assert rules["require-trusted-types-for"] == "'script'" and rules["trusted-types"] == "'none'"
    assert "unsafe" not in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert "set-cookie" not in answer.headers


def test_nothing_is_inline() -> None:
    page = (FOLDER / "page.html").read_text()
    assert not re.search(r"<script(?![^>]* src=)|<style|\sstyle=|\son\w+=", page)


def test_a_file_is_cached_for_good_and_the_page_requested_each_time(client: httpx.Client) -> None:
    build = console_files().build
    assert "immutable" in client.get(f"/console/{build}/start.js").headers["cache-control"]
    for path in ("/console", f"/console/{build}/start.js"):
        first = client.get(path)
        again = client.get(path, headers={"If-None-Match": first.headers["etag"]})
        assert again.status_code == 304 and again.content == b"" and again.headers["etag"] == first.headers["etag"]
    assert client.get("/console").headers["cache-control"] == "no-cache"


def test_a_file_is_compressed_for_those_who_take_it(server: Server, client: httpx.Client) -> None:
    path = f"/console/{console_files().build}/style.css"
    with httpx.Client(base_url=client.base_url) as other:
        packed = other.get(path, headers={"Accept-Encoding": "gzip"})
        plain = other.get(path, headers={"Accept-Encoding": "gzip;q=0"})
    assert packed.headers["content-encoding"] == "gzip" and "content-encoding" not in plain.headers
    assert int(packed.headers["content-length"]) < int(plain.headers["content-length"]) / 2
    assert packed.content == plain.content == (FOLDER / "style.css").read_bytes()
    assert packed.headers["vary"] == "Accept-Encoding"


@pytest.mark.parametrize(
    "name", ["absent.js", "files.py", "..%2Ffiles.py", "%2Fetc%2Fpasswd", "page.html", "vendor/lock.json"]
)
def test_no_other_file_is_served(client: httpx.Client, name: str) -> None:
    assert_problem(client.get(f"/console/{console_files().build}/{name}"), 404, "unknown-path")


def test_a_file_of_another_version_is_not_there(client: httpx.Client) -> None:
    assert_problem(client.get("/console/0123456789abcdef/start.js"), 404, "unknown-path")


def test_all_of_it_is_small() -> None:
    found = console_files()
    assert sum(len(file.compressed) for file in found.others.values()) + len(found.page.compressed) < 300_000
    assert all(gzip.decompress(file.compressed) == file.content for file in found.others.values())


MOST_OF_A_VIEW = 120_000
"""Compressed bytes that the first view may take."""


@pytest.mark.parametrize("view", sorted(path.name for path in (FOLDER / "views").iterdir()))
def test_a_first_view_is_small(view: str) -> None:
    found = console_files()
    named = re.findall(r'(?:src|href)="console/[0-9a-f]+/([^"]*)"', found.page.content.decode())
    wanted, loaded = [*named, "frame.js", f"views/{view}"], set[str]()
    while wanted:
        path = wanted.pop()
        if path not in loaded:
            loaded.add(path)
            imported = re.findall(r'(?:from|^import)\s*"(\.[^"]+)"', found.others[path].content.decode(), re.MULTILINE)
            wanted += [posixpath.normpath(posixpath.join(posixpath.dirname(path), name)) for name in imported]
    assert len(loaded) > 15
    size = len(found.page.compressed) + sum(len(found.others[path].compressed) for path in loaded)
    assert size <= MOST_OF_A_VIEW


def test_the_name_of_the_folder_changes_with_any_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text("<script src='console/{build}/a.js'></script>")
    builds = []
    for text in ("1", "2"):
        (tmp_path / "a.js").write_text(text)
        monkeypatch.setattr(files, "FOLDER", tmp_path)
        found = files.console_files.__wrapped__()
        assert found.build in found.page.content.decode()
        builds.append(found.build)
    assert builds[0] != builds[1]


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.relative_to(FOLDER).as_posix())
def test_our_own_modules_make_no_markup_of_text_and_ask_nobody_else(path: Path) -> None:
    text = path.read_text()
    assert not re.search(
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|dangerously", text
    )
    assert not re.search(r"https?://(?!www\.w3\.org/)", re.sub(r"//.*", "", text)), "an address of another site"
    assert not re.search(r"document\.cookie|EventSource", text)


def test_what_is_vendored_is_what_was_locked() -> None:
    entries = json.loads((VENDOR / "lock.json").read_text())
    locked = {name: file["sha256"] for entry in entries for name, file in entry["files"].items()}
    there = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in VENDOR.iterdir()}
    del there["lock.json"]
    assert there == locked
    for entry in entries:
        assert re.fullmatch(r"\d+\.\d+\.\d+", entry["version"]) and len(entry["sha512"]) == 128
        assert entry["licence"] in {"MIT", "Apache-2.0"}
        assert any(name.endswith(".LICENSE") for name in entry["files"]), entry["name"]


def test_vendored_modules_import_only_what_lies_beside_them() -> None:
    for path in VENDOR.glob("*.js"):
        for name in re.findall(r"""\bfrom\s*["']([^"'\n]+)["']\s*;""", path.read_text()):
            assert (VENDOR / name).is_file(), f"{path.name} imports {name}"


def test_every_kind_of_file_is_packaged() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["service.console"]
    packaged = {path for pattern in patterns for path in FOLDER.glob(pattern)}
    lying = {path for path in FOLDER.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert lying <= packaged
