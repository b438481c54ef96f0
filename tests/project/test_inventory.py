"""The bill of materials says what the lock files say, and the comparison with advisories says what it could not do."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.project.test_lock import locked, version
from tests.service.server import no_service

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts/inventory.py"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The script by an interpreter that has the standard library alone."""
    command = [sys.executable, "-I", "-S", str(SCRIPT), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.thorough
@pytest.mark.parametrize("profile", ["service", "ros"])
def test_the_bill_lists_what_is_locked(profile: str) -> None:
    done = run("sbom", profile)
    assert done.returncode == 0 and run("sbom", profile).stdout == done.stdout
    bill = json.loads(done.stdout)
    assert (bill["bomFormat"], bill["specVersion"], bill["version"]) == ("CycloneDX", "1.5", 1)
    assert bill["serialNumber"].startswith("urn:uuid:")
    found = {one["name"]: one for one in bill["components"] if one["purl"].startswith("pkg:pypi/")}
    wanted = {name: version(requirement) for name, requirement in locked(profile).items()}
    if profile != "ros":
        wanted["torch"] = (ROOT / "requirements/torch.lock").read_text().strip().removeprefix("torch==")
        assert "hashes" not in found["torch"]
        scripts = {one["name"] for one in bill["components"] if one["purl"].startswith("pkg:npm/")}
        kept = json.loads((ROOT / "service/console/vendor/lock.json").read_text())
        assert scripts == {one["name"] for one in kept}
    assert {name: one["version"] for name, one in found.items()} == wanted
    for name, one in found.items():
        assert one["purl"] == one["bom-ref"] == f"pkg:pypi/{name}@{one['version']}"
        assert name == "torch" or all(len(each["content"]) == 64 for each in one["hashes"])
    assert sorted(bill["dependencies"][0]["dependsOn"]) == sorted(one["bom-ref"] for one in bill["components"])


@contextmanager
def database(*answers: Any) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """A server that answers each batch of queries by the next of some functions: its address, and what it was asked."""
    asked: list[dict[str, Any]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            asked.append({"path": self.path, **body})
            content = answers[len(asked) - 1](body["queries"])
            self.send_response(200)
            self.end_headers()
            self.wfile.write(content if isinstance(content, bytes) else json.dumps(content).encode())

        def log_message(self, *_: object) -> None: ...

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/", asked
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def results(queries: list[dict[str, Any]], **known: Any) -> dict[str, Any]:
    return {"results": [known.get(query["package"]["name"].replace("-", "_"), {}) for query in queries]}


def test_every_locked_version_is_compared() -> None:
    with database(lambda queries: results(queries)) as (address, asked):
        done = run("advisories", "service", "--source", address)
    assert done.returncode == 0 and "0 are named" in done.stdout
    (batch,) = asked
    assert batch["path"] == "/v1/querybatch"
    compared = {one["package"]["name"]: one["version"] for one in batch["queries"]}
    assert compared.items() >= {name: version(one) for name, one in locked("service").items()}.items()
    assert {one["package"]["ecosystem"] for one in batch["queries"]} == {"PyPI", "npm"}


def test_advisories_are_named_over_all_pages_and_change_the_status() -> None:
    first = {"vulns": [{"id": "GHSA-1"}], "next_page_token": "more"}
    with database(
        lambda queries: results(queries, h11=first, anyio={"vulns": [{"id": "PYSEC-7"}]}),
        lambda queries: results(queries, h11={"vulns": [{"id": "CVE-2"}, {"id": "GHSA-1"}]}),
    ) as (address, asked):
        done = run("advisories", "--source", address)
    assert done.returncode == 1 and "2 are named" in done.stdout
    assert f"h11 {version(locked('service')['h11'])}: CVE-2, GHSA-1\n" in done.stdout
    assert [query["page_token"] for query in asked[1]["queries"]] == ["more"]


def test_a_database_that_is_not_reached_is_said_to_be() -> None:
    with no_service() as gone:
        done = run("advisories", "--source", gone)
    assert (done.returncode, done.stdout) == (2, "")
    assert "NOT COMPARED" in done.stderr and "could not be asked" in done.stderr and "Nothing is known" in done.stderr


@pytest.mark.parametrize("answer", [b"<html>", [], {}, {"results": []}, {"results": None}])
def test_an_answer_of_another_kind_is_no_comparison(answer: Any) -> None:
    with database(lambda _: answer) as (address, _):
        done = run("advisories", "--source", address)
    assert done.returncode == 2 and "NOT COMPARED" in done.stderr
