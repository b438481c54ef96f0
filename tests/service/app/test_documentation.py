"""The page at /docs: what it loads, what it may load, and what a browser shows."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.service.server import Server, assert_problem

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
LOADED = {"docs/swagger-ui.css", "docs/swagger-ui-bundle.js", "docs/start.js"}


def test_the_page_loads_only_files_of_this_service(client: httpx.Client) -> None:
    response = client.get("/docs")
    assert response.status_code == 200 and response.headers["content-type"].startswith("text/html")
    named = re.findall(r'(?:src|href)="(?!data:)([^"]*)"', response.text)
    assert set(named) == LOADED
    for address in named:
        assert client.get(f"/{address}").status_code == 200


@pytest.mark.parametrize("path", ["docs", *sorted(LOADED)])
def test_nothing_inline_runs_and_nothing_is_loaded_from_elsewhere(client: httpx.Client, path: str) -> None:
    response = client.get(f"/{path}")
    rules = dict(rule.split(maxsplit=1) for rule in response.headers["content-security-policy"].split("; "))
    assert rules["default-src"] == "'none'" and rules["script-src"] == rules["style-src"] == "'self'"
    assert not re.search(r"<script(?! src=)|<style|style=|onload=", client.get("/docs").text)
    assert response.headers["x-content-type-options"] == "nosniff"
    again = client.get(f"/{path}", headers={"If-None-Match": response.headers["etag"]})
    assert again.status_code == 304 and again.content == b""


@pytest.mark.parametrize("name", ["absent.js", "..%2Fdocumentation.py", "%2Fetc%2Fpasswd", "__init__.py"])
def test_no_other_file_is_served(client: httpx.Client, name: str) -> None:
    assert_problem(client.get(f"/docs/{name}"), 404, "unknown-path")


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service that a proxy publishes under /robots/placerec."""
    server = Server(tmp_path_factory.mktemp("published"), {"root_path": "/robots/placerec"})
    yield server.wait("/livez")
    server.stop()


@pytest.mark.thorough
@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("prefix", [pytest.param("", marks=pytest.mark.thorough), "/robots/placerec"])
def test_a_browser_shows_every_operation(published: Server, prefix: str, tmp_path: Path) -> None:
    described = published.client.get("/openapi.json").json()
    address = f"http://127.0.0.1:{published.port}{prefix}/docs"
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}", "--enable-logging=stderr"]
    command = [str(BROWSER), *options, "--virtual-time-budget=60000", "--dump-dom", address]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=500)
    for item in described["paths"].values():
        for operation in item.values():
            assert operation["operationId"] in done.stdout
    assert f"127.0.0.1:{published.port}{prefix}" in done.stdout, "requests go below the prefix"
    assert "Content Security Policy" not in done.stderr
