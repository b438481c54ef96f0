"""Why a frame and a place score as they do."""

from __future__ import annotations

from pydantic import BaseModel, Field


class RelativeBox(BaseModel):
    """Shares of the upright frame's width and height."""

    left: float
    top: float
    right: float
    bottom: float


class ExplainedRegion(BaseModel):
    """A region of interest and what it carries."""

    layer: str
    word: int = Field(description="The word of the vocabulary that it was assigned to.")
    box: RelativeBox
    loss: float = Field(description="What the score would lose without it.")


class RegionPair(BaseModel):
    """Two regions of one word that are each other's nearest; positions in the two lists."""

    query: int
    match: int


class CellPair(BaseModel):
    """Two cells that choose each other; row and column of each in `grid`."""

    query: tuple[int, int]
    match: tuple[int, int]
    gain: float = Field(description="What the pair adds to the score.")


class ExplanationView(BaseModel):
    """The score, taken apart: the sum of `words` and of the gains of all `cells`."""

    score: float
    words: list[float] = Field(description="What each word of the vocabulary adds (j_u, as it counts in the score).")
    query_regions: list[ExplainedRegion] = Field(description="Those that carry most, the most important first.")
    match_regions: list[ExplainedRegion] | None = Field(
        description="The same of the other frame; null where no picture of it is kept."
    )
    regions: list[RegionPair] = Field(description="Which region answers to which, among those listed.")
    cells: list[CellPair] = Field(description="Which cell answers to which; empty without a second stage.")
    grid: tuple[int, int] = Field(description="Rows and columns of the cells; (0, 0) without a second stage.")


class MatchExplanation(ExplanationView):
    """Why a query's best match scores as it does."""

    place: str = Field(description="Id of the best match.")
    match_picture: str = Field(
        description="From what the regions of the match were found again: image, thumbnail (which is smaller than "
        "the frame that was enrolled, so they may differ a little), or none."
    )
    picture: str | None = Field(
        description="Path of a PNG with both frames side by side, for some minutes; null where none is kept."
    )
