"""The base of all models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    Value = TypeVar("Value")
    Known = Annotated[Value, "a later service may know more"]
else:

    class Known:
        """A text of which these values are known; at run time any text, as a later service may know more."""

        def __class_getitem__(cls, values: Any) -> Any:
            return str


class Model(BaseModel):
    """An answer. Fields that this version does not know are ignored; validators are built at the first use."""

    model_config = ConfigDict(extra="ignore", defer_build=True, protected_namespaces=())


__all__ = ["Known", "Model"]
