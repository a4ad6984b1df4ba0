"""Decimals mean what they say: verdicts at the edge of support are those of exact fractions."""

from fuzz.exact_stability import check_equilibrium, check_hulls


def test_hull_rules_and_area_ratio_equal_exact_fractions_at_the_edge() -> None:
    assert check_hulls(seed=0, windows=20_000) >= 20_000


def test_equilibrium_equals_exact_fractions_at_the_edge() -> None:
    assert check_equilibrium(seed=0, cases=150) == 150
