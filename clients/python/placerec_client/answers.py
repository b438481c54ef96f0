"""Answers: whether one is final, and the exception for one that is no success."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TypeVar

from pydantic import ValidationError

from placerec_client._http import httpx
from placerec_client.errors import PlacerecError, Problem, UnexpectedAnswer
from placerec_client.model import Model
from placerec_client.problems import BY_SLUG

PROBLEM = "application/problem+json"
OVERLOADED = frozenset({429, 502, 503, 504})
UNKNOWN_OUTCOME = frozenset({502, 504})
"""Statuses of a proxy that does not know what became of the request."""

Answer = TypeVar("Answer", bound=Model)


def parsed(model: type[Answer], content: bytes | str) -> Answer:
    """The model of an answer.

    Raises:
        UnexpectedAnswer: the content does not have the model's fields.
    """
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        raise UnexpectedAnswer(f"The service's answer is no {model.__name__}: {error}") from error


def is_passing(response: httpx.Response) -> bool:
    """Whether the same request may succeed in a moment.

    A 503 of the service without ``Retry-After`` does not pass by itself: an operator has to act.
    """
    return response.status_code in OVERLOADED and ("retry-after" in response.headers or not _is_problem(response))


def retry_after(response: httpx.Response) -> float | None:
    """Seconds that the service asks to wait; None if it does not say."""
    seconds = response.headers.get("retry-after", "")
    return float(seconds) if seconds.isdecimal() else None


def refusal(response: httpx.Response, after_loss: bool = False) -> PlacerecError:
    """The exception for an unsuccessful answer, whose content was read."""
    if _is_problem(response):
        try:
            body = json.loads(response.content)
        except ValueError:
            body = None
        if isinstance(body, dict):
            return problem_of(body, response.status_code, retry_after(response), after_loss)
    return UnexpectedAnswer(
        f"{response.request.url} answered {response.status_code}. Is it a placerec service?", response.status_code
    )


def problem_of(
    body: Mapping[str, object], status: int | None = None, after: float | None = None, after_loss: bool = False
) -> Problem:
    """The exception for a problem object, of the class for its kind; of ``Problem`` for a kind not known here."""
    kind = BY_SLUG.get(str(body.get("type", "")).rpartition(":")[2], Problem)
    given = body.get("status")
    return kind(body, status or (given if isinstance(given, int) else 500), after, after_loss)


def _is_problem(response: httpx.Response) -> bool:
    return str(response.headers.get("content-type", "")).startswith(PROBLEM)
