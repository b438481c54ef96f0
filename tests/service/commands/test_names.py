"""Whatever name a command is given, its requests reach what they are for, or nothing is sent; old words are refused.

The commands are found in the application, so that a new one is held to this as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from tests.service.commands.conftest import COMMAND, Placerec
from tests.service.refusing import Seen, refusing_server
from tests.service.scenes import jpeg

HOSTILE = ("", ".", "..", "a/b", "%2e%2e", "\n", "\u202e", "ü b?#")
REFUSED = ("", ".", "..", "a/b")
ELSEWHERE = {
    "bench": "sends frames of its own for a while, by a path that `query` has, too",
    "maps import": "reads the file first, and has the name among its parameters",
    "jobs list": "has the name among its parameters",
}
NEEDED = {
    "maps edit": ("--description", "d"),
    "maps places edit": ("--x", "1", "--y", "2"),
    "calibrate": ("--itself",),
}
"""Words that these commands need besides."""


def commands(found: Any = COMMAND, words: tuple[str, ...] = ()) -> Iterator[tuple[str, list[Any]]]:
    """Every command that speaks to a service, and its parameters that have to be given."""
    for name, one in getattr(found, "commands", {}).items():
        yield from commands(one, (*words, name))
    if any(parameter.name == "url" for parameter in found.params):
        given = [one for one in found.params if one.required or one.name in ("map_id", "yes")]
        if any(is_name(one) for one in given):
            yield " ".join(words), given


def is_name(parameter: Any) -> bool:
    return parameter.type_descriptor.annotation in (str, list[str])


def words_of(command: str, parameters: list[Any], names: dict[str, str], folder: Path) -> list[str]:
    """The words of a command with these names; files are there if they are to be read."""
    options: list[str] = [*command.split(), *NEEDED.get(command, ())]
    arguments = []
    for one in parameters:
        value = names[one.name] if is_name(one) else str(folder / ("out" if one.name == "file" else "frame.jpg"))
        if one.name == "yes":
            options.append(one.opts[0])
        elif one.param_type_name == "option":
            options.append(f"{one.opts[0]}={value}")
        else:
            arguments.append(str(folder) if one.name == "recording" else value)
    return [*options, "--", *arguments]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("command", "parameters"), list(commands()), ids=lambda one: one if isinstance(one, str) else ""
)
def test_no_name_leads_a_command_astray(
    placerec: Placerec, refused: tuple[str, Seen], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    command: str, parameters: list[Any],
) -> None:  # fmt: skip
    if command in ELSEWHERE:
        pytest.skip(ELSEWHERE[command])
    url, seen = refused
    monkeypatch.setenv("PLACEREC_URL", url)
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "frame.jpg").write_bytes(jpeg(1, 32, 24))

    def sent(names: dict[str, str]) -> tuple[Seen, str]:
        seen.clear()
        told = placerec(*words_of(command, parameters, names, tmp_path / "frames"), status=1).stderr
        return list(seen), told

    plain = {one.name: f"name-{number}" for number, one in enumerate(parameters) if is_name(one)}
    harmless, _ = sent(plain)
    assert harmless
    for hole, marker in plain.items():
        for name in HOSTILE:
            found, told = sent({**plain, hole: name})
            wanted = [(method, path.replace(marker, quote(name, safe=""))) for method, path in harmless]
            if name in REFUSED and (wanted != harmless or not found):
                assert found == [], f"{command} {hole} {name!r}"
                assert "is no name" in told or "cannot name" in told
            else:
                assert found == wanted, f"{command} {hole} {name!r}"


@pytest.fixture(scope="module")
def refused() -> Iterator[tuple[str, Seen]]:
    with refusing_server() as server:
        yield server


@pytest.mark.parametrize(
    ("group", "old"), [("maps places", "forget"), ("maps sequences", "forget"), ("keys", "revoke")]
)
def test_old_words_name_the_new_one(placerec: Placerec, group: str, old: str) -> None:
    told = placerec(*group.split(), old, "lab", "x", status=2).stderr
    assert "use delete." in " ".join(told.replace("│", " ").split())
    assert f" {old} " not in placerec(*group.split(), "--help").stdout


@pytest.mark.parametrize("words", [("maps",), ("maps", "places", "lab"), ("maps", "sequences", "lab")])
@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_name_is_refused_before_a_question(placerec: Placerec, words: tuple[str, ...], name: str) -> None:
    group, within = [one for one in words if one != "lab"], [one for one in words if one == "lab"]
    result = placerec(*group, "delete", *within, "--", name, status=1, stdin="y\n")
    assert "is no name" in result.stderr and "[y/N]" not in result.output


def test_other_words_are_unknown(placerec: Placerec) -> None:
    never: list[tuple[str, ...]] = [("maps", old) for old in ("forget", "revoke", "end")]
    never += [("keys", "forget"), ("maps", "places", "revoke"), ("maps", "sequences", "revoke")]
    for words in (*never, ("maps", "places", "revoked"), ("jobs", "forget"), ("forget",)):
        assert "No such command" in placerec(*words, status=2).stderr


def test_a_traverse_is_refused_before_a_frame_is_read(placerec: Placerec, monday: Path) -> None:
    for name in ("..", ".", "a/b", "\u202e", "x" * 129):
        told = placerec("enrol", monday, "--map", "lab", "--create", "--sequence", name, status=1).stderr
        assert "cannot name a sequence" in told and "--sequence" in told
