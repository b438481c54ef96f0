"""The lock files: exact, complete, in step with pyproject.toml, and without an address."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CLIENT = tomllib.loads((ROOT / "clients/python/pyproject.toml").read_text())["project"]


def locked(name: str) -> dict[str, Requirement]:
    """The entries of a lock file by canonical name; each must be one exact version with its hashes."""
    text = (ROOT / "requirements" / f"{name}.lock").read_text()
    entries: dict[str, Requirement] = {}
    for block in re.split(r"\n(?=\S)", text):
        if block.startswith("#"):
            continue
        head, *hashes = re.sub(r"\\\n|\n +#.*", "", block).split("--hash=")
        requirement = Requirement(head.strip())
        assert re.fullmatch(r"==[^*,]+", str(requirement.specifier)), head
        assert hashes and all(re.fullmatch(r"sha256:[0-9a-f]{64}", text.strip()) for text in hashes), head
        entries[canonicalize_name(requirement.name)] = requirement
    return entries


def version(requirement: Requirement) -> str:
    return next(iter(requirement.specifier)).version


def declared(texts: list[str]) -> dict[str, Requirement]:
    return {str(canonicalize_name(requirement.name)): requirement for requirement in map(Requirement, texts)}


def test_torch_is_pinned_exactly_and_alone() -> None:
    pin = (ROOT / "requirements/torch.lock").read_text().split()
    assert pin == [str(declared(PROJECT["project"]["dependencies"])["torch"])]
    assert re.fullmatch(r"torch==\d+\.\d+\.\d+", pin[0])
    for name in ("service", "development"):
        assert [entry for entry in locked(name) if re.match(r"torch$|triton|nvidia-|cuda-", entry)] == []


def test_the_packages_of_ros_are_locked_within_their_ranges() -> None:
    entries = locked("ros")
    for package, requirement in declared(PROJECT["dependency-groups"]["ros"]).items():
        assert requirement.specifier.contains(version(entries[package])), package
    for package, requirement in declared(CLIENT["dependencies"]).items():
        assert requirement.specifier.contains(version(entries[package])), package


@pytest.mark.parametrize(
    ("name", "extras"),
    [
        ("service", []),
        ("lab", ["lab"]),
        ("replica", ["milvus"]),
        ("development", ["dev", "lab", "milvus"]),
    ],
)
def test_every_dependency_is_locked_within_its_range(name: str, extras: list[str]) -> None:
    texts = PROJECT["project"]["dependencies"] + PROJECT["build-system"]["requires"]
    for extra in extras:
        texts = texts + PROJECT["project"]["optional-dependencies"][extra]
    wanted = declared(texts)
    del wanted["torch"], wanted["placerec-client"]
    wanted |= declared(CLIENT["dependencies"] + CLIENT["optional-dependencies"]["stream"])
    entries = locked(name)
    outside = {
        package: requirement
        for package, requirement in wanted.items()
        if package not in entries or not requirement.specifier.contains(version(entries[package]))
    }
    assert outside == {}, "scripts/lock brings them in step"


def test_the_client_is_that_of_the_checkout() -> None:
    from placerec_client.version import VERSION

    wanted = declared(PROJECT["project"]["dependencies"])["placerec-client"]
    assert wanted.specifier.contains(VERSION) and PROJECT["project"]["version"] == VERSION
    assert all("placerec-client" not in locked(name) for name in ("service", "development"))


def test_development_is_the_service_and_more() -> None:
    service, development = locked("service"), locked("development")
    assert {name: str(entry) for name, entry in development.items() if name in service} == {
        name: str(entry) for name, entry in service.items()
    }
    assert set(development) - set(service)


def test_opencv_still_reads_caffe() -> None:
    assert version(locked("service")["opencv-python-headless"]).startswith("4.")


OWN = {f"http://{host}" for host in ("0.0.0.0", "127.0.0.1", "etcd", "localhost", "milvus", "placerec")}
OWN |= {"https://the-host", "postgresql://placerec"}
"""Addresses of this machine and of parts of a cluster."""

ADVISORIES = {"https://api.osv.dev"}
"""The database that scripts/advisories asks: it has no packages."""


@pytest.mark.parametrize("folder", ["requirements", "scripts", "docker", ".ci"])
def test_no_registry_is_named(folder: str) -> None:
    files = [path for path in (ROOT / folder).iterdir() if path.is_file()] + [ROOT / "pyproject.toml"]
    addresses = [
        f"{path.relative_to(ROOT)}: {address}"
        for path in files
        for address in re.findall(r"\w+://[^\s/:;\"'$]+", path.read_text())
        if address not in OWN | ADVISORIES
    ]
    assert addresses == []
