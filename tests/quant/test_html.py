"""Numbers as pages write them."""

import pytest

from rts2.quant.html import difference, number


@pytest.mark.parametrize(
    ("value", "digits", "plain", "signed"),
    [
        (None, 2, "–", "–"),
        (1234.5, 1, "1,234.5", "+1,234.5"),
        (-0.25, 2, "−0.25", "−0.25"),
        (-0.0004, 2, "0.00", "±0.00"),
        (0.0, 0, "0", "±0"),
    ],
)
def test_numbers_are_written_as_people_do(
    value: float | None, digits: int, plain: str, signed: str
) -> None:
    assert number(value, digits) == plain
    assert difference(value, digits) == signed
