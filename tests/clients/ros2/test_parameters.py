"""Parameters: their check, the key, and the table in the documents."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from core.names import TEXT
from placerec_ros.parameters import PARAMETERS, TRAVERSE, InvalidParameters, Settings, settings

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "how-to" / "ros2.md"


def values(**given: Any) -> dict[str, Any]:
    return {**{one.name: one.default for one in PARAMETERS}, "map": "lab", **given}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"map": ""}, "has to be the id of a map"),
        ({"map": "My Map"}, "No map is named 'My Map'"),
        ({"url": "127.0.0.1:8000"}, "url has to be an address"),
        ({"url": "http://ann:secret@robot"}, "url has to be an address"),
        ({"camera": "no/name"}, "No camera"),
        ({"queue_length": 0}, "queue_length is 0; it can be 1 to 100"),
        ({"queue_length": True}, "type int"),
        ({"deadline": 1}, "type float"),
        ({"deadline": 0.0}, "it can be 0.05 to 60"),
        ({"camera_yaw": 270.0}, "it can be -180 to 180"),
        ({"image_type": "h264"}, "one of auto, compressed, raw"),
        ({"verify": "sometimes"}, "one of auto, always, never"),
        ({"map_frame": ""}, "name a frame"),
        *(({"cameras": names}, "different names of topics") for names in ("a,a", "a,", "1st", "a/b", "ü")),
        ({"cameras": "front,left", "camera": "lens"}, "parameter camera has to be empty"),
        ({"cameras": "front,left", "camera_frame": "lens"}, "parameter camera_frame has to be empty"),
        ({"cameras": "front,left", "use_tf_static": False}, "need use_tf_static"),
        ({"rig_query": True}, "needs cameras"),
        *(
            ({"datum": text}, "latitude,longitude")
            for text in ("48.8", "a,b", "1,2,3,4", "1,2,x", "91,0", "48,nan", "90,0", "1,2,nan")
        ),
        *(({"sequence": name}, "cannot name a traverse") for name in ("a/b", ".", "..", "\u202e", "\x85", "x" * 129)),
        ({"key_file": "/nowhere/key"}, "key file /nowhere/key cannot be read: No such file"),
    ],
)
def test_a_value_that_cannot_be_is_named(given: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidParameters, match=said):
        settings(values(**given), {})


def test_names_are_those_that_the_service_takes() -> None:
    assert TRAVERSE.pattern == TEXT
    for name in ("monday", "...", "ü b?#", "x" * 128, ""):
        assert settings(values(sequence=name), {}).sequence == name


def test_the_key_comes_from_the_file_or_the_variable_and_is_shown_nowhere(tmp_path: Path) -> None:
    file = tmp_path / "key"
    file.write_text("placerec_of-the-file\n")
    from_file = settings(values(key_file=str(file)), {"PLACEREC_KEY": "placerec_of-the-variable"})
    assert from_file.key == "placerec_of-the-file"
    assert settings(values(), {"PLACEREC_KEY": "placerec_of-the-variable"}).key == "placerec_of-the-variable"
    assert settings(values(), {}).key is None
    assert "placerec_of" not in repr(from_file) + str(from_file)


@pytest.mark.parametrize("content", [b"", b"two words", b"\xff\xfe\x00"])
def test_a_file_that_holds_no_key_is_refused_without_its_content(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "key").write_bytes(content)
    with pytest.raises(InvalidParameters) as refused:
        settings(values(key_file=str(tmp_path / "key")), {})
    assert "words" not in str(refused.value)


def test_every_parameter_is_a_setting() -> None:
    fields = set(Settings.__dataclass_fields__) - {"key"}
    assert fields == {one.name for one in PARAMETERS}


def table() -> str:
    """The table of parameters as the page has it."""
    rows = ["| parameter | default | range | meaning |", "|---|---|---|---|"]
    for one in PARAMETERS:
        reach = ", ".join(f"`{choice}`" for choice in one.choices)
        if one.least is not None and one.most is not None:
            reach = f"{one.least:g} to {one.most:g}"
        default = (
            "" if one.default == "" else f"`{one.default if isinstance(one.default, str) else json.dumps(one.default)}`"
        )
        rows.append(f"| `{one.name}` | {default} | {reach} | {one.description} |")
    return "\n".join(rows)


def test_the_page_says_which_can_be_changed_at_any_time() -> None:
    said = PAGE.read_text().partition("At any time can be changed:")[2].partition(";")[0]
    assert set(re.findall("`([a-z_]+)`", said)) == {one.name for one in PARAMETERS if one.live}


def test_the_page_lists_all_parameters() -> None:
    assert table() in PAGE.read_text(), f"docs/how-to/ros2.md should have this table:\n{table()}"
