"""What pydantic and FastAPI refuse, in words for whoever sent it."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from common.network.model import NetworkSettings
from common.problems import InvalidField, problem_of_fields
from common.wire import WireOptions


def test_a_field_of_several_types_is_one_complaint_under_its_own_name() -> None:
    with pytest.raises(ValidationError) as refused:
        WireOptions(inner=300, copies=0)
    problem = problem_of_fields([{**each, "loc": ("body", *each["loc"])} for each in refused.value.errors()])
    assert problem.errors == [
        InvalidField(place="body", name="copies", detail="Input should be greater than or equal to 1"),
        InvalidField(
            place="body",
            name="inner",
            detail="Input should be 0, or 16, 32, 64 or 128",
        ),
    ]


def test_a_spread_below_zero_is_told_what_is_accepted() -> None:
    with pytest.raises(ValidationError) as refused:
        NetworkSettings(spread=-1)
    problem = problem_of_fields([{**each, "loc": ("query", *each["loc"])} for each in refused.value.errors()])
    assert problem.detail == "spread: Input should be 'auto' or 'paper', or greater than 0"


def test_broken_json_is_said_to_be_that() -> None:
    error = {
        "type": "json_invalid",
        "loc": ("body", 17),
        "msg": "JSON decode error",
        "ctx": {"error": "Expecting value"},
    }
    assert problem_of_fields([error]).detail == "body: not JSON: Expecting value after 17 characters"


@pytest.mark.parametrize("precision", ["float16", 99, 0])
def test_what_a_precision_may_be_is_said_at_once(precision: object) -> None:
    with pytest.raises(ValidationError) as refused:
        WireOptions.model_validate({"precision": precision})
    problem = problem_of_fields([{**each, "loc": ("body", *each["loc"])} for each in refused.value.errors()])
    assert problem.detail == "precision: expected float64, float32, or 2 to 32 bits"


def test_a_misspelt_choice_is_guessed() -> None:
    with pytest.raises(ValidationError) as refused:
        NetworkSettings.model_validate({"spread": "papr", "mapping": "moon"})
    problem = problem_of_fields([{**each, "loc": ("query", *each["loc"])} for each in refused.value.errors()])
    detail = problem.detail or ""
    assert detail.startswith("spread: Input should be 'auto' or 'paper', or ")
    assert detail.endswith("; did you mean 'paper'?; mapping: Input should be 'height' or 'autoassociative'")
