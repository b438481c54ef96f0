"""The encoders installed."""

from __future__ import annotations

from fastapi import APIRouter, Depends

from service.app.schemas import EncoderPage
from service.http.dependencies import EngineDep, single_values

router = APIRouter(prefix="/v1/encoders", tags=["encoders"], dependencies=[Depends(single_values)])


@router.get("")
def list_encoders(engine: EngineDep) -> EncoderPage:
    """List the models and vocabularies installed here, damaged ones too, with what they are made of."""
    return EncoderPage(items=engine.catalogue.describe(), next_cursor=None)
