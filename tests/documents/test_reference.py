"""The pages of docs/reference say what the code says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.documents.reference import FOLDER
from tests.service.map_jobs import finished
from tests.service.server import Server


@pytest.mark.thorough
def test_every_metric_is_on_the_page(tmp_path: Path) -> None:
    service = Server(tmp_path / "service", {"backup_dir": tmp_path / "backups"}).wait()
    try:
        finished(service, service.client.post("/v1/backups").raise_for_status().json())
        series = re.findall(r"^# TYPE (placerec_\w+)", service.client.get("/metrics").text, re.MULTILINE)
    finally:
        assert service.stop() == 0
    described = set(re.findall(r"`(placerec_\w+)`", (FOLDER / "metrics-and-logs.md").read_text()))
    assert described == {name for name in series if not name.endswith("_created")}
