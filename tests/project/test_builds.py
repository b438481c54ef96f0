"""The wheel of the client; building it in the checkout leaves nothing there that Git would take for the project's."""

from __future__ import annotations

import subprocess
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from placerec_client.version import VERSION
from tests.project.sources import CLIENT, ROOT

METADATA = {
    *("Name", "Version", "Summary", "Requires-Python"),
    *("Requires-Dist", "Description-Content-Type"),
}


@pytest.mark.thorough
def test_the_client_is_published_as_a_typed_wheel_of_its_own(tmp_path: Path) -> None:
    """The script imports it in an empty environment, too, without the checkout."""
    done = subprocess.run([ROOT / "scripts/wheel", tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    wheel, source = sorted(tmp_path.iterdir(), key=lambda path: path.suffix, reverse=True)
    assert done.stdout.split() == [str(wheel), str(source)]
    assert (wheel.name, source.name) == (
        f"placerec_client-{VERSION}-py3-none-any.whl",
        f"placerec_client-{VERSION}.tar.gz",
    )
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        metadata = Parser().parsestr(archive.read(f"placerec_client-{VERSION}.dist-info/METADATA").decode())
    package = CLIENT / "placerec_client"
    modules = {path.relative_to(CLIENT).as_posix() for path in package.rglob("*.py")}
    assert names == {*modules, "placerec_client/py.typed"}
    with tarfile.open(source) as sources:
        assert {f"placerec_client-{VERSION}/{name}" for name in (*names, "README.md")} <= set(sources.getnames())
    assert set(metadata.keys()) >= METADATA and "Typing :: Typed" in metadata.get_all("Classifier", [])
    assert str(metadata.get_payload()).strip() == (CLIENT / "README.md").read_text().strip()
    needed = {line.partition(">")[0].partition("<")[0] for line in metadata.get_all("Requires-Dist", [])}
    assert needed == {"httpx", "pydantic", "websockets"}
