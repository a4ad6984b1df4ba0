"""Decimals mean what they say: verdicts at the edge of support are those of exact fractions."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import stack
from fuzz.exact_stability import check_equilibrium, check_hulls, mirrored_case

from marl_pack.backend import Backend
from marl_pack.items import make_stream
from marl_pack.plan import Plan
from marl_pack.stability import (
    OrientedItem,
    hull_1,
    hull_alpha,
    in_equilibrium,
    lbcp,
    reference,
    stable_mask,
)


def test_hull_rules_and_area_ratio_equal_exact_fractions_at_the_edge() -> None:
    assert check_hulls(seed=0, windows=20_000) >= 20_000


def test_equilibrium_equals_exact_fractions_at_the_edge() -> None:
    assert check_equilibrium(seed=0, cases=150) == 150


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize(("margin", "stands"), [(0.99, True), (1.0, False), (1.01, False)])
def test_a_margin_that_is_just_reached_at_a_slanted_edge_is_not_enough(
    backend: Backend, margin: float, stands: bool
) -> None:
    # Pillars of one cell at (0, 0), (3, 4) and (6, 0). The hull's edge from (0, 1) to (3, 5) is 5
    # long, and the centre of mass, (2, 2), lies exactly 1 from it.
    bins = stack((8, 5, 3), (0, 0, 0, 1, 1, 1), (3, 4, 0, 1, 1, 1), (6, 0, 0, 1, 1, 1))
    bins = replace(bins, backend=backend)
    item = OrientedItem(torch.tensor([[[8, 5, 1]]], dtype=torch.int16), ((-0.25, -0.1),))
    for rule in (hull_1, hull_alpha, lbcp):
        assert bool(rule(bins, item, margin)[0, 0, 0, 0]) == stands


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize(("offset", "stands"), [(-1e-17, True), (0.0, False), (1e-17, False)])
def test_a_centre_of_mass_next_to_the_middle_is_not_in_it(
    backend: Backend, offset: float, stands: bool
) -> None:
    # Pillars at (0, 2) and (1, 1) under a box of 2 x 6: its middle (1, 3) is a corner of the hull.
    bins = replace(stack((2, 6, 3), (0, 2, 0, 1, 1, 1), (1, 1, 0, 1, 1, 1)), backend=backend)
    item = OrientedItem(torch.tensor([[[2, 6, 1]]], dtype=torch.int16), ((0.0, offset),))
    assert bool(hull_1(bins, item)[0, 0, 0, 0]) == stands


@pytest.mark.parametrize(
    ("weights", "offset", "margin"),
    [((7.141092, 2.93, 4.861280880536798), (1e-9, 0.0, 0.0), 0.3),
     ((2.289, 0.78, 4.382970433658), (0.0, -1e-9, 0.0), 0.0)],
)  # fmt: skip
def test_arms_of_a_billionth_do_not_mislead_the_simplex(
    weights: tuple[float, float, float], offset: tuple[float, float, float], margin: float
) -> None:
    # A plank that its pillar alone does not hold, and an item that balances it: so small an arm is
    # a pivot that blows up rounding errors.
    left, length = (1, 6) if margin else (3, 9)
    boxes = np.array([[left, 0, 0, 1, 2, 1], [0, 0, 1, length, 2, 1]])
    heights, empty = np.zeros((12, 2), np.int64), np.zeros((12, 2), np.int64)
    for x, y, _, w, d, h in boxes.tolist():
        reference.place_box(heights, empty, (x, y), (w, d, h))
    x = 0 if margin else 3
    case = {
        "heightmap": heights, "empty_map": empty, "item": (1, 1, 1), "bin_height": 6,
        "boxes": boxes, "weights": weights[:2], "weight": weights[2], "com_offset": offset,
    }  # fmt: skip
    for own, place in ((case, x), (mirrored_case(case), 11 - x)):
        assert stable_mask("equilibrium", **own, margin=margin)[place].all()


def test_a_decimal_of_any_width_means_what_it_says() -> None:
    # As wide as its bin of 10 x 2, on a box at x = 0; its centre of mass lies on the edge x = 1.
    maps = np.zeros((2, 10, 2), np.int64)
    maps[0, 0] = 1
    for number in (-0.4, np.float32(-0.4), np.longdouble(-0.4)):
        offset = (number, 0.0, 0.0)
        mask = stable_mask("hull_1", *maps, (10, 2, 1), 4, com_offset=offset)  # type: ignore[arg-type]  # NumPy floats
        assert not mask.any()
    narrow = np.array([[0.7, 0.5, 1.0]], np.float32)
    plan = Plan.of_boxes((2, 2, 2), [[0, 0, 0, 1, 2, 1]], narrow)
    assert plan.loads.tolist() == [[0.7, 0.5, 1.0]]
    items = make_stream({"items": [[1, 1, 1]], "weights": narrow[:, 0]}, (2, 2, 2))
    assert items.rows.weights.tolist() == [0.7]  # type: ignore[attr-defined]  # a given sequence


def test_weights_of_boxes_that_are_masked_are_refused() -> None:
    maps = np.zeros((2, 2, 2), np.int64)
    maps[0] = 1
    weights = np.ma.masked_array([1.0], [True])
    with pytest.raises(ValueError, match="weights: needs one number for each of"):
        stable_mask("equilibrium", *maps, (1, 1, 1), 4, [[0, 0, 0, 2, 2, 1]], weights=weights)


@pytest.mark.parametrize("reach", [10**2, 10**4, 10**6, 10**7, 10**8, 2 * 10**8])
@pytest.mark.parametrize(("middle", "stands"), [(1.5, True), (3.0, False), (6.0, False)])
def test_a_long_plank_is_judged_as_a_short_one(reach: int, middle: float, stands: bool) -> None:
    # The pillar is 0 ... 1. Equal weights on the plank's ends balance at 0, so together with the
    # plank, as heavy as each of them, the centre of mass is a third of the plank's.
    boxes = [(0, 0, 0, 1, 1, 1), (-reach, 0, 1, 2 * reach, 1, 1),
             (-reach, 0, 2, 1, 1, 1), (reach - 1, 0, 2, 1, 1, 1)]  # fmt: skip
    loads = [(4.0, 0.5, 0.5), (0.1, middle, 0.5),
             (0.1, 0.5 - reach, 0.5), (0.1, reach - 0.5, 0.5)]  # fmt: skip
    assert in_equilibrium(boxes, loads) == stands
