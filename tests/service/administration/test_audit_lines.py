"""Reading the trail from its end: torn and long lines, files that were moved away, and any block size."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pytest

from core.errors import InvalidCursor
from service.administration import audit_lines
from service.administration.audit_lines import Position, lines_of_files


def line(number: int, width: int = 0) -> str:
    return json.dumps({"number": number, "width": "x" * width}) + "\n"


def numbers(path: Path, before: Position | None = None) -> list[int | None]:
    """The numbers of the lines from the latest to the oldest; None for a line that is no JSON."""
    return [None if one.fields is None else one.fields["number"] for one in lines_of_files(path, before)]


@pytest.mark.parametrize("block", [1, 2, 7, 64, 65536])
def test_lines_come_from_the_last_to_the_first_whatever_the_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(audit_lines, "BLOCK", block)
    path = tmp_path / "audit.jsonl"
    path.write_text("".join(line(number, 13 * number) for number in range(30)))
    assert numbers(path) == list(range(29, -1, -1))
    found = list(lines_of_files(path, None))
    text = path.read_bytes()
    for one in found:
        assert one.fields is not None
        whole = line(one.fields["number"], 13 * one.fields["number"]).encode()
        assert text[one.position.offset :].startswith(whole) and one.size == len(whole) - 1
        assert numbers(path, one.position) == list(range(one.fields["number"] - 1, -1, -1))


@pytest.mark.parametrize("block", [1, 5, 65536])
def test_a_torn_last_line_is_left_out_and_one_in_the_middle_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(audit_lines, "BLOCK", block)
    path = tmp_path / "audit.jsonl"
    path.write_text(line(0) + '{"number": 1, "wid' + "\n" + "\n" + "[1]\n" + line(2) + '{"number": 3, "torn')
    assert [number for number in numbers(path) if number is not None] == [2, 0]
    path.write_text('{"number": 3, "torn')
    assert [number for number in numbers(path) if number is not None] == []
    path.write_text("")
    assert numbers(path) == []
    path.unlink()
    assert numbers(path) == []


def test_a_line_that_is_too_long_is_passed_over_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_lines, "BLOCK", 64)
    monkeypatch.setattr(audit_lines, "LONGEST_LINE", 200)
    path = tmp_path / "audit.jsonl"
    path.write_text(line(0) + line(1, 5000) + line(2))
    assert [number for number in numbers(path) if number is not None] == [2, 0]
    sizes = [one.size for one in lines_of_files(path, None)]
    assert max(sizes) <= 200 + 64 and sum(sizes) > 4500, "what was read is counted, a piece at a time"
    pieces = [one.position for one in lines_of_files(path, None)]
    for position in pieces:
        assert set(numbers(path, position)) <= {0, 2, None} and numbers(path, position)[-1:] in ([0], [])


def test_files_that_were_moved_away_follow_the_latest_first(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_text(line(0) + line(1))
    path.rename(tmp_path / "audit.jsonl.1")
    path.write_text(line(2) + line(3))
    (position, *_) = (one.position for one in lines_of_files(path, None))
    path.rename(tmp_path / "audit.jsonl-20261122")
    path.write_text(line(4))
    with gzip.open(tmp_path / "audit.jsonl.9.gz", "wt") as packed:
        packed.write(line(99))
    (tmp_path / "other.jsonl").write_text(line(98))
    assert numbers(path) == [4, 3, 2, 1, 0]
    assert numbers(path, position) == [2, 1, 0], "a cursor holds although its file was moved away"
    (tmp_path / "audit.jsonl-20261122").unlink()
    assert numbers(path, position) == []


def test_a_position_is_two_numbers() -> None:
    assert Position.parsed(Position(7, 11).text()) == Position(7, 11)
    for wrong in ("", "7", "7:", ":7", "a:1", "1:-1", "1:2:3", "1:²", "1:" + "9" * 20):
        with pytest.raises(InvalidCursor):
            Position.parsed(wrong)
