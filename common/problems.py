"""Every error as a problem detail (RFC 9457), whatever framework answers with it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from itertools import islice
from typing import Any

from pydantic import BaseModel, Field

from common.errors import ParameterError, SurfacelinkError, guess, hint

MEDIA_TYPE = "application/problem+json"

BRANCH = re.compile(r"literal\[|constrained-|function-|(int|float|str|bool)$")
"""What pydantic puts behind a field's name to say which of several accepted types its complaint is about."""


MOST_REFUSED = 8
"""Parameters that are refused by name at once: there is no end to those that can be given."""


SCHEMAS = "#/components/schemas/{model}"
"""Where an OpenAPI document has the schema of a model."""


class InvalidField(BaseModel):
    """One part of a request that was not acceptable."""

    place: str = Field(description="Where it stands: query, path, header or body.", examples=["query"])
    name: str = Field(description="Its name.", examples=["shape"])
    detail: str = Field(description="What is accepted.", examples=["expected rows,columns"])


class Problem(BaseModel):
    """An error as RFC 9457 describes it."""

    type: str = Field(description="The kind of error, a path that explains it.", examples=["/problems/not-found"])
    title: str = Field(description="The same for every error of the kind.", examples=["Not found"])
    status: int = Field(description="The HTTP status.", examples=[404])
    detail: str | None = Field(default=None, description="What was wrong this time, and what is accepted.")
    errors: list[InvalidField] | None = Field(default=None, description="The fields at fault, where there are some.")


def described(words: str) -> dict[str, Any]:
    """OpenAPI's description of an answer that is a problem."""
    return {"description": words, "content": {MEDIA_TYPE: {"schema": {"$ref": SCHEMAS.format(model=Problem.__name__)}}}}


def slug(kind: type[SurfacelinkError]) -> str:
    """The name of an error class in a problem's type: NotReadyError is not-ready."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", kind.__name__.removesuffix("Error")).lower()


def kinds(root: type[SurfacelinkError] = SurfacelinkError) -> dict[str, type[SurfacelinkError]]:
    """All kinds of error there are, by their name in a problem's type."""
    found = {slug(root): root}
    for child in root.__subclasses__():
        found |= kinds(child)
    return found


def problem_of(error: SurfacelinkError) -> Problem:
    """The problem an error of ours means."""
    return Problem(type=f"/problems/{slug(type(error))}", title=error.title, status=error.status, detail=error.detail)


def problem_of_status(status: int, detail: str | None = None) -> Problem:
    """The problem that says no more than its HTTP status (RFC 9457, section 4.2.1)."""
    return Problem(type="about:blank", title=HTTPStatus(status).phrase, status=status, detail=detail)


def refused_parameters(
    document: Mapping[str, Any], path: str, method: str, given: Iterable[str]
) -> list[dict[str, Any]]:
    """Query parameters that would do nothing, for `problem_of_fields`: those that a call does not have, and all but the
    last of those that are given more than once.

    Parameters
    ----------
    document : mapping
        The service's OpenAPI document; what stands in it nowhere has no parameters.
    path, method : str
        Of the call, as the document names it.
    given : iterable of str
        Names of the parameters that were given, as often as they were.
    """
    times = Counter(given)
    call = document["paths"].get(path, {}).get(method.lower(), {})
    accepted = [each["name"] for each in call.get("parameters", ()) if each["in"] == "query"]

    def told(name: str) -> str:
        if name in accepted:
            return "given more than once; one value is taken"
        return f"no such parameter{hint(name, accepted)}" if accepted else "no such parameter; none is accepted here"

    refused = (name[:40] for name in times if name not in accepted or times[name] > 1)
    return [{"loc": ("query", name), "msg": told(name)} for name in islice(refused, MOST_REFUSED)]


def problem_of_fields(errors: Sequence[Mapping[str, Any]]) -> Problem:
    """The problem of a request that pydantic refused, by its errors as `invalid_fields` takes them."""
    fields = invalid_fields(errors)
    detail = "; ".join(f"{field.name}: {field.detail}" for field in fields)
    return problem_of(ParameterError(detail)).model_copy(update={"errors": fields})


def invalid_fields(errors: Sequence[Mapping[str, Any]]) -> list[InvalidField]:
    """Each field that pydantic refused, once; the values it met are not repeated.

    Parameters
    ----------
    errors : sequence of mappings
        As pydantic's ``ValidationError.errors()`` gives them, the place (query, body, ...) first in ``loc``.
    """
    found: dict[tuple[str, str], list[str]] = {}
    guesses: dict[tuple[str, str], str] = {}
    for error in errors:
        place, *name = (str(part) for part in error["loc"] or ("body",))
        message = str(error["msg"]).removeprefix("Value error, ")
        if error.get("type") == "json_invalid" and name:  # FastAPI's: the place is a number of characters
            message, name = f"not JSON: {error['ctx']['error']} after {name[-1]} characters", []
        if error.get("type") in ("bool_parsing", "bool_type"):
            message = "Input should be true or false"
        label = ".".join(part for part in name if not BRANCH.match(part)) or place
        found.setdefault((place, label), []).append(message)
        if error.get("type") == "literal_error" and isinstance(error["input"], str):
            guesses[place, label] = guess(error["input"], re.findall("'([^']+)'", error["ctx"]["expected"]))
    return [
        InvalidField(
            place=place,
            name=name,
            detail=", or ".join([messages[0], *(text.removeprefix("Input should be ") for text in messages[1:])])
            + guesses.get((place, name), ""),
        )
        for (place, name), messages in found.items()
    ]
