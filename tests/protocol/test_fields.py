"""What a refused field is told as."""

from typing import Any, Self

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from neurove_protocol.fields import WrongField


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid")
    bins: int = Field(5, ge=1)
    name: str


class Outer(BaseModel):
    inner: tuple[Inner, ...]
    least: int = 0

    @model_validator(mode="after")
    def _together(self) -> Self:
        if self.least:
            raise ValueError("least=1 goes with nothing")
        return self


def wrong(**fields: Any) -> WrongField:
    with pytest.raises(ValidationError) as caught:
        Outer.model_validate(fields)
    return WrongField.of(caught.value)


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"inner": [{"name": "a", "bins": 0}]}, "inner.0.bins=0: Input should be greater than or equal to 1"),
        ({"inner": [{}]}, "inner.0.name=missing: Field required"),
        (
            {"inner": [{"name": "missing", "bins": "missing"}]},
            "inner.0.bins='missing': Input should be a valid integer",
        ),
        ({"inner": [], "least": 1}, "least=1 goes with nothing"),
    ],
)
def test_the_sentence_names_the_first_wrong_field_its_value_and_its_bound(fields, sentence):
    assert wrong(**fields).sentence.startswith(sentence)


def test_an_unknown_field_is_clipped_however_long_its_name_and_its_value_are():
    found = wrong(inner=[{"name": "a", "x" * 10_000: "y" * 10_000}])
    assert found.kind == "extra_forbidden"
    assert len(found.sentence) < 250
