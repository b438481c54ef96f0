"""The page on operations is held to the settings, and what it says is tested to the tests."""

from __future__ import annotations

import re

from service.settings import PREFIX, Settings
from tests.service.server import ROOT

PAGE = ROOT / "docs" / "reference" / "limits.md"
ROW = re.compile(rf"^\| `{PREFIX}([A-Z_]+)` \| ([^|]+) \| ([^|]+) \| (?:`([^`]+)`|none) \|$", re.MULTILINE)
ROWS = {name.lower(): test for name, _, _, test in ROW.findall(PAGE.read_text())}

NO_LIMITS = {
    "host", "port", "allow_anonymous", "audit_file", "root_path", "data_dir", "backup_dir", "models_dir", "encoder",
    "threads", "device", "thumbnail_side", "log_level",
    "milvus", "milvus_token", "milvus_certificate", "milvus_database", "database", "row_cache_bytes",
    "rehearsal", "allowed_hosts", "event_days", "answer_days", "review_days", "picture_days", "audit_days",
}  # fmt: skip
"""Settings that are no limits of what is taken."""


def test_every_limit_is_on_the_page_and_nothing_else() -> None:
    assert set(ROWS) == set(Settings.model_fields) - NO_LIMITS
