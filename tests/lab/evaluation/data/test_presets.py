from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from lab.evaluation.data.presets import TraverseSizes, read_datasets

FAMILY = """
[families.walk]
truth = "±1 frames"
rule = { kind = "frames", tolerance = 1 }
source = "somebody"
"""


def test_a_protocol_has_what_its_family_gives_and_it_does_not() -> None:
    own = 'title = "Own"\nsource = "else"\nsizes = { queries = 3, references = 4 }\nqueries = ["night"]'
    (found,) = read_datasets(f'{FAMILY}\n[protocols."walk.1"]\nfamily = "walk"\n{own}')
    assert (found.name, found.title, found.truth, found.source) == ("walk.1", "Own", "±1 frames", "else")
    assert (found.references, found.queries, found.sizes) == (("reference", "ref"), ("night",), TraverseSizes(3, 4))
    assert found.rule is not None
    assert [true.tolist() for true in found.rule([Path("0"), Path("1")], [Path("0"), Path("1"), Path("2")])] == [
        [0, 1],
        [0, 1, 2],
    ]


@pytest.mark.parametrize(
    ("row", "error"),
    [
        ('family = "wlak"', KeyError),
        ('family = "walk"\nsouce = "else"', ValidationError),
        ('family = "walk"\nsizes = { queries = 3 }', ValidationError),
        ('family = "walk"\nexclude = { kind = "arround", tolerance = 1 }', KeyError),
        ('family = "walk"\nexclude = { kind = "around", frames = 1 }', ValidationError),
        ('family = "walk"\nlayouts = [{ kind = "kitti", sequence = 5 }]', ValidationError),
    ],
)
def test_a_wrong_table_is_refused(row: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        read_datasets(f'{FAMILY}\n[protocols.one]\ntitle = "One"\n{row}')
