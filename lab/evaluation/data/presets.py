"""Data sets and the protocols by which they are evaluated, each by its name, as ``presets.toml`` lists them.

A protocol says which traverse is the reference and which the query, the truth, the references that a query is not
matched against, and how many images there should be.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, validate_call
from pydantic.dataclasses import dataclass

from lab.evaluation.data.layouts import DatasetLayout, Names, downloaded, folders, group, vpr_bench, vpr_tutorial
from lab.evaluation.data.listed_layouts import dbstruct, gsv_cities, mapillary, patch_netvlad
from lab.evaluation.data.rules import Rule, around, every, frames, groups, nearest, within
from lab.evaluation.data.sequences import baidu, kitti, tum

THESIS = "The thesis"

RULES = (around, every, frames, groups, nearest, within)
LAYOUTS = (
    baidu, dbstruct, downloaded, folders, group, gsv_cities, kitti, mapillary, patch_netvlad, tum, vpr_bench,
    vpr_tutorial,
)  # fmt: skip


def _made(makers: tuple[Callable[..., Any], ...]) -> BeforeValidator:
    """A table becomes what the function of the name ``kind`` makes of its other values."""
    by_name = {maker.__name__: validate_call(maker) for maker in makers}
    return BeforeValidator(lambda table: by_name[table["kind"]](**{key: table[key] for key in table if key != "kind"}))


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TraverseSizes:
    """T, R, and with reduced references T' and R' (Table 2.2).

    source: who counts so.
    """

    queries: int
    references: int
    answerable: int | None = None
    kept: int | None = None
    source: str = THESIS


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Dataset:
    """One data set under one protocol.

    truth: the rule, in words.
    references, queries: names that the folder of a traverse goes by; the first that is there is taken.
    rule: the truth where no file gives it; None where one must.
    sizes: None where there are none to compare with.
    layouts: the published ways to lay it out, tried before the two folders themselves.
    excluded: the references that a query is not matched against, in words; ``exclude`` finds it.
    source: the publication whose protocol it is.
    """

    name: str
    title: str
    truth: str
    references: Names = ("reference", "ref")
    queries: Names = ("query",)
    rule: Annotated[Rule, _made(RULES)] | None = None
    sizes: TraverseSizes | None = None
    layouts: tuple[Annotated[DatasetLayout, _made(LAYOUTS)], ...] = ()
    excluded: str = ""
    exclude: Annotated[Rule, _made(RULES)] | None = None
    source: str = "the thesis"


def read_datasets(text: str) -> tuple[Dataset, ...]:
    """The data sets of a text in the form of ``presets.toml``; fields that a protocol does not give are its family's.

    Raises:
        KeyError: there is no family or no ``kind`` of that name.
        pydantic.ValidationError: a field or an argument is missing, unknown or of another type.
    """
    tables = tomllib.loads(text)
    families = {"": {}, **tables.get("families", {})}
    return tuple(
        Dataset(name=name, **families[table.pop("family", "")] | table) for name, table in tables["protocols"].items()
    )


DATASETS = read_datasets(Path(__file__).with_suffix(".toml").read_text("utf-8"))
