"""Checks of single values: nothing is accepted that is not what it says."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from marl_pack.checks import decimals, real_number, whole_number


@pytest.mark.parametrize("value", [0, 7, np.int8(7), np.uint64(7)])
def test_a_whole_number_is_an_int_or_a_numpy_integer(value: Any) -> None:
    number = whole_number(value, "seed", 0, 7)
    assert type(number) is int
    assert number == value


HUGE = pytest.param(10**5000, id="5001 digits")


@pytest.mark.parametrize(
    "value",
    [True, np.True_, 1.0, 1.5, np.float64(1), "1", b"1", None, [1], math.nan, -1, 8, HUGE],
)
def test_what_is_no_whole_number_of_the_range_is_refused_in_one_line(value: Any) -> None:
    with pytest.raises(ValueError, match=r"^seed: needs a whole number from 0 to 7, not .{1,60}$"):
        whole_number(value, "seed", 0, 7)


@pytest.mark.parametrize("value", [3, 0.5, np.float32(0.5), np.int16(3), Fraction(1, 2)])
def test_a_real_number_is_any_finite_number(value: Any) -> None:
    assert real_number(value, "weight") == value


@pytest.mark.parametrize(
    "value", [True, np.False_, "1", None, math.nan, -math.inf, 1j, HUGE, [1.0]]
)
def test_what_is_no_finite_number_is_refused_in_one_line(value: Any) -> None:
    with pytest.raises(ValueError, match=r"^weight: needs a finite number, not .{1,60}$"):
        real_number(value, "weight")


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble])
def test_a_number_of_any_width_means_the_decimal_that_it_shows_as(dtype: type) -> None:
    numbers = np.array(["0.7", "-0.4", "2.5"]).astype(dtype)
    assert decimals(numbers).tolist() == [0.7, -0.4, 2.5]
    assert [real_number(number, "weight") for number in numbers] == [0.7, -0.4, 2.5]


def test_a_fraction_that_is_no_decimal_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^margin: needs a decimal number, not Fraction\(1, 3\)"):
        real_number(Fraction(1, 3), "margin")
