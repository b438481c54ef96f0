from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lab.evaluation.cache as module
from core.errors import InvalidTraverse
from lab.evaluation.cache import CacheEntry, EvaluationCache, cache_key, code_digest, default_folder, files_digest

ENTRY = CacheEntry({"identity": "made@0", "n": [1.5, None]}, {"scores": np.arange(6, dtype=np.float32).reshape(2, 3)})


def test_what_is_stored_is_loaded(tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "deep" / "folder")
    assert cache.load("a") is None
    cache.store("a", ENTRY)
    loaded = cache.load("a")
    assert loaded is not None and loaded.values == ENTRY.values
    assert loaded.arrays["scores"].dtype == np.float32
    assert loaded.arrays["scores"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert [path.name for path in (tmp_path / "deep/folder").iterdir()] == ["a.evaluation"]
    assert cache.load("b") is None


def test_an_entry_without_arrays(tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path)
    cache.store("a", CacheEntry({"points": []}))
    assert cache.load("a") == CacheEntry({"points": []})


@pytest.mark.thorough
def test_any_changed_byte_or_missing_end_counts_as_absent(tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path)
    cache.store("a", ENTRY)
    path = tmp_path / "a.evaluation"
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        assert cache.load("a") is None
    for end in range(0, len(whole), 7):
        path.write_bytes(whole[:end])
        assert cache.load("a") is None
    path.write_bytes(whole)
    assert cache.load("a") is not None


def test_objects_are_never_cached(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="allow_pickle"):
        EvaluationCache(tmp_path).store("a", CacheEntry({}, {"scores": np.array([{}], dtype=object)}))


def test_without_a_folder_nothing_is_cached() -> None:
    cache = EvaluationCache(None)
    cache.store("a", ENTRY)
    assert cache.load("a") is None and cache.writable


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    cache = EvaluationCache(tmp_path / "file")
    cache.store("a", ENTRY)
    assert not cache.writable
    assert cache.load("a") is None


def test_the_default_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "placerec/evaluations"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert default_folder() == Path("/home/somebody/.cache/placerec/evaluations")


def test_a_key_depends_on_the_parts_and_on_the_code(monkeypatch: pytest.MonkeyPatch) -> None:
    key = cache_key(kind="run", system="a@0")
    assert key == cache_key(system="a@0", kind="run")
    assert key != cache_key(kind="run", system="b@0")
    with monkeypatch.context() as patched:
        patched.setattr(module, "code_digest", lambda: "other")
        assert key != cache_key(kind="run", system="a@0")


@pytest.mark.parametrize("library", ["faiss-cpu", "numba", "numpy", "opencv-python-headless", "scipy", "torch"])
def test_a_key_depends_on_what_the_libraries_are(monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    key = cache_key(kind="run")
    others = {**module._libraries(), library: "0.0.1"}
    assert others.keys() == module._libraries().keys()
    monkeypatch.setattr(module, "_libraries", lambda: others)
    assert key != cache_key(kind="run")


def test_the_code_digest_covers_what_computes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("core/vlad.py", "lab/systems/hog.py", "lab/evaluation/report/page.py", "core/store/map.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1")
    monkeypatch.setattr(module, "__file__", str(tmp_path / "lab/evaluation/cache.py"))

    def digest() -> str:
        code_digest.cache_clear()
        return code_digest()

    first = digest()
    for name, counts in [
        ("lab/evaluation/report/page.py", False),
        ("core/store/map.py", False),
        ("lab/systems/hog.py", True),
        ("core/vlad.py", True),
    ]:
        (tmp_path / name).write_text("2")
        assert (digest() != first) == counts, name
    code_digest.cache_clear()


def test_files_count_by_content_and_order(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a", "b", "c")]
    for path, text in zip(paths, ("1", "2", "1"), strict=True):
        path.write_text(text)
    a, b, c = paths
    assert files_digest([a, b]) == files_digest([c, b])
    assert files_digest([a, b]) != files_digest([b, a])
    with pytest.raises(InvalidTraverse, match="cannot be read"):
        files_digest([tmp_path / "missing"])
