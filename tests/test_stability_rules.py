"""Small cases that can be checked by hand, and refused arguments."""

import numpy as np
import pytest
import torch
from conftest import boxes_of, stack

from marl_pack.bins import Bins
from marl_pack.stability import RULES, in_equilibrium, make_rule, stable_mask
from marl_pack.stability.reference import lbcp_bearing

SOUND = ("hull_alpha", "lbcp", "equilibrium")


def ask(rule: str, bins: Bins, item: tuple[int, int, int], **parameters: object) -> np.ndarray:
    return stable_mask(
        rule,
        bins.heightmap[0].numpy(),
        bins.empty_map[0].numpy(),
        item,
        bins.height,
        boxes_of(bins, 0),
        **parameters,
    )


@pytest.mark.parametrize("rule", RULES)
def test_on_the_floor_every_box_inside_the_bin_stands(rule: str) -> None:
    mask = ask(rule, stack((5, 4, 6)), (3, 2, 6))
    assert mask.sum() == 3 * 3
    assert mask[:3, :3].all()
    assert not ask(rule, stack((5, 4, 6)), (3, 2, 7)).any()
    assert not ask(rule, stack((5, 4, 6)), (6, 2, 1)).any()


@pytest.mark.parametrize("rule", RULES)
def test_a_box_too_high_for_what_is_below_it_is_refused(rule: str) -> None:
    bins = stack((4, 4, 6), (0, 0, 0, 4, 4, 3))
    assert ask(rule, bins, (2, 2, 3)).sum() == 9
    assert not ask(rule, bins, (2, 2, 4)).any()


@pytest.mark.parametrize("rule", ["hull_1", *SOUND])
def test_a_box_balanced_on_an_edge_does_not_stand(rule: str) -> None:
    # Seen from the front, a 4-wide box over a 2-wide one; its middle is x + 2:
    #   x=0: middle 2 on the block's right edge   B B B B .
    #                                             A A . . .
    bins = stack((6, 2, 6), (0, 0, 0, 2, 2, 2))
    assert not ask(rule, bins, (4, 2, 1))[0, 0]
    assert ask(rule, bins, (3, 2, 1))[0, 0]  # middle 1.5 over the block
    # A block in the middle holds a box whose middle is half a cell from its edge, not on it.
    bins = stack((6, 2, 6), (2, 0, 0, 2, 2, 2))
    assert ask(rule, bins, (4, 2, 1))[:, 0].tolist() == [False, True, False, False, False, False]
    assert ask(rule, bins, (3, 2, 1))[:, 0].tolist() == [False, True, True, False, False, False]


@pytest.mark.parametrize("rule", ["hull_1", *SOUND])
def test_diagonal_pillars_hold_only_what_lies_between_their_outer_corners(rule: str) -> None:
    # Seen from above: pillars at (0, 0) and (3, 3) under a 4 x 4 plate. The middle (2, 2) lies on
    # the line between them, strictly inside the hull of their squares (a narrow hexagon).
    bins = stack((6, 6, 9), (0, 0, 0, 1, 1, 3), (3, 3, 0, 1, 1, 3))
    assert ask(rule, bins, (4, 4, 1))[0, 0]
    # The middle (2.5, 2) of a 5 x 4 plate: the hexagon's side runs from (1, 0) to (4, 3) and on,
    # x - y = 1; 2.5 - 2 is inside it. A 6 x 4 plate's middle (3, 2) lies on that side.
    assert ask(rule, bins, (5, 4, 1))[0, 0]
    assert not ask(rule, bins, (6, 4, 1))[0, 0]


def test_a_stack_that_is_exactly_balanced_is_not_in_strict_equilibrium() -> None:
    # Seen from the front, B's middle is over A's edge if B is 4 wide:   B B B B
    #                                                                    A A . .
    for width, stands in ((3, True), (4, False), (5, False)):
        boxes = [(0, 0, 0, 2, 2, 1), (0, 0, 1, width, 2, 1)]
        assert in_equilibrium(np.array(boxes)) == stands


def test_three_pillars_hold_their_triangle() -> None:
    bins = stack((5, 5, 9), (0, 0, 0, 1, 1, 2), (4, 0, 0, 1, 1, 2), (0, 4, 0, 1, 1, 2))
    assert ask("hull_alpha", bins, (5, 5, 1))[0, 0]  # (2.5, 2.5) on x + y = 5, hull up to x + y = 6
    bins = stack((6, 6, 9), (0, 0, 0, 1, 1, 2), (4, 0, 0, 1, 1, 2), (0, 4, 0, 1, 1, 2))
    assert not ask("hull_alpha", bins, (6, 6, 1))[0, 0]  # (3, 3) on x + y = 6, the hull's edge


def test_the_papers_figure_a_heavy_box_on_an_overhang() -> None:
    # hull_1 sees only the top layer; under the heavy box C the plank B tips over A's edge.
    #          C C C
    #          C C C        C: 3 x 4 x 8
    #        B B B B B      B: 5 x 4 x 1, middle 3.5 over A
    #      A A A A          A: 4 x 4 x 2
    bins = stack((10, 4, 12), (0, 0, 0, 4, 4, 2), (1, 0, 2, 5, 4, 1))
    heavy = (3, 4, 8)
    assert ask("hull_1", bins, heavy)[3, 0]
    for rule in SOUND:
        assert not ask(rule, bins, heavy)[3, 0], rule
    # Weights 20 at 3.5 and 96 at 4.5: together at 4.33, past A's edge at 4.
    tipped = np.vstack((boxes_of(bins, 0), [3, 0, 3, *heavy]))
    assert not in_equilibrium(tipped)
    # Where all of C stands over A, it stands by every rule.
    for rule in RULES:
        assert ask(rule, bins, heavy)[1, 0], rule


def test_weights_belong_to_their_boxes_in_whatever_order_these_are_given() -> None:
    # As above: K on the left end of P holds it down. K comes first in the list.
    boxes = np.array([[0, 0, 2, 2, 1, 5], [0, 0, 0, 3, 1, 1], [0, 0, 1, 5, 1, 1]])
    bins = stack((5, 1, 9), *map(tuple, boxes[[1, 2, 0]].tolist()))
    maps = bins.heightmap[0].numpy(), bins.empty_map[0].numpy()
    for weights, stands in (([9.0, 1.0, 1.0], True), ([0.01, 9.0, 1.0], False)):
        mask = stable_mask("equilibrium", *maps, (1, 1, 1), 9, boxes, weights=weights, weight=1.0)
        assert mask[4, 0] == stands


def test_a_counterweight_counts_in_equilibrium_alone() -> None:
    # The plank's end carries little, since a heavy box holds its other end down.
    #   K K
    #   K K     N
    #   P P P P P       P: 5 x 1 x 1 on A (0 … 3), N's middle past A's edge
    #   A A A . .
    bins = stack((5, 1, 9), (0, 0, 0, 3, 1, 1), (0, 0, 1, 5, 1, 1), (0, 0, 2, 2, 1, 5))
    item = (1, 1, 1)
    assert ask("equilibrium", bins, item)[4, 0]
    assert ask("hull_1", bins, item)[4, 0]
    assert not ask("hull_alpha", bins, item)[4, 0]
    assert not ask("lbcp", bins, item)[4, 0]
    assert ask("lbcp", bins, item)[2, 0]
    # With a weight of 20 the moment about A's edge (x = 3) is 20 · 1.5 against 10 · 2 + 5 · 0.5.
    assert not ask("equilibrium", bins, item, weight=20.0)[4, 0]
    # 15 · 1.5 = 22.5 is exactly balanced, which is not strictly standing.
    assert not ask("equilibrium", bins, item, weight=15.0)[4, 0]
    assert ask("equilibrium", bins, item, weight=14.9)[4, 0]


def test_a_gap_inside_the_polygon_carries_by_lbcp() -> None:
    # A bridge over two pillars may be loaded in its middle.
    bins = stack((6, 2, 9), (0, 0, 0, 1, 2, 2), (4, 0, 0, 1, 2, 2), (0, 0, 2, 5, 2, 1))
    assert not ask("hull_alpha", bins, (2, 2, 2))[2, 0]
    assert ask("lbcp", bins, (2, 2, 2))[2, 0]
    assert ask("equilibrium", bins, (2, 2, 2))[2, 0]


def test_a_cell_bears_only_if_its_whole_square_lies_in_the_polygon() -> None:
    # Counting a cell of which one corner lies in the polygon lets these fall.
    for boxes, last in (
        ([(3, 5, 0, 3, 2, 4), (6, 4, 0, 2, 2, 4), (5, 2, 4, 2, 5, 1)], (5, 6, 5, 4, 2, 4)),
        ([(4, 2, 0, 1, 3, 1), (3, 4, 1, 3, 1, 5), (4, 2, 6, 1, 5, 1)], (2, 3, 7, 5, 1, 2)),
    ):
        bins = stack((10, 10, 12), *boxes)
        assert in_equilibrium(np.array(boxes))
        assert not in_equilibrium(np.array([*boxes, last]))
        for rule in SOUND:
            assert not ask(rule, bins, last[3:])[last[:2]], rule
    # The second is not refused for another reason: its own contact holds it, and the cell that
    # decides, (4, 3), is a gap whose square touches the polygon with corners but is not in it.
    assert ask("hull_1", bins, last[3:])[last[:2]]
    bearing = lbcp_bearing((10, 10), np.array(boxes))
    assert bearing[4, 2:7].tolist() == [False, False, True, False, False]


def test_area_ratio_counts_area_and_corners() -> None:
    # A 5 x 5 plate over a block of 5 x 3: 60 %, not more, and no pair of corners.
    bins = stack((5, 5, 9), (0, 1, 0, 5, 3, 2))
    assert not ask("area_ratio", bins, (5, 5, 1))[0, 0]
    # Four pillars in the corners and a bar: 4 + 12 of 25 cells, four corners.
    corners = [(x, y, 0, 1, 1, 2) for x in (0, 4) for y in (0, 4)]
    bins = stack((5, 5, 9), *corners, (0, 1, 0, 4, 3, 2))
    assert ask("area_ratio", bins, (5, 5, 1))[0, 0]  # 64 % and 4 corners
    bins = stack((5, 5, 9), *corners, (0, 1, 0, 5, 2, 2))
    assert not ask("area_ratio", bins, (5, 5, 1))[0, 0]  # 56 %: the paper asks for more than 60
    assert ask("area_ratio", bins, (5, 5, 1), thresholds="code")[0, 0]  # the code for 50
    bins = stack((5, 5, 9), *corners[:3], (0, 1, 0, 5, 3, 2), (2, 4, 0, 2, 1, 2))
    assert not ask("area_ratio", bins, (5, 5, 1))[0, 0]  # 80 %, not more, and 3 corners
    bins = stack((5, 5, 9), *corners[:3], (0, 1, 0, 5, 3, 2), (1, 4, 0, 3, 1, 2))
    assert ask("area_ratio", bins, (5, 5, 1))[0, 0]  # 84 % and 3 corners
    assert not ask("area_ratio", bins, (5, 5, 1), thresholds="code")[0, 0]  # the code asks for 85


def test_area_ratio_is_not_sound() -> None:
    # 4 of 5 columns and two corners are not enough for it, though the box stands …
    bins = stack((5, 2, 9), (0, 0, 0, 4, 2, 2))
    assert not ask("area_ratio", bins, (5, 2, 1))[0, 0]
    assert ask("hull_alpha", bins, (5, 2, 1))[0, 0]
    # … and what stands on the far end of a plank it does not ask.
    bins = stack((10, 4, 12), (0, 0, 0, 4, 4, 2), (1, 0, 2, 5, 4, 1))
    assert ask("area_ratio", bins, (3, 4, 8))[3, 0]


@pytest.mark.parametrize("rule", ["hull_1", *SOUND])
def test_an_offset_centre_of_mass_moves_the_mask(rule: str) -> None:
    # A 4-wide box over a 2-wide block at x = 2: stands if its centre of mass is over 2 … 4.
    bins = stack((8, 2, 6), (2, 0, 0, 2, 2, 2))
    assert ask(rule, bins, (4, 2, 1))[:5, 0].tolist() == [False, True, False, False, True]
    # 2 + 4 · 0.25 = 3 cells from its low end: x = 0 puts it over the middle of the block.
    shifted = ask(rule, bins, (4, 2, 1), com_offset=(0.25, 0, 0))
    assert shifted[:5, 0].tolist() == [True, False, False, False, True]
    shifted = ask(rule, bins, (4, 2, 1), com_offset=(-0.25, 0, 0))
    assert shifted[:5, 0].tolist() == [False, False, True, False, True]


@pytest.mark.parametrize("rule", ["hull_1", *SOUND])
def test_a_margin_shrinks_the_support_polygon(rule: str) -> None:
    # A 3-wide box, middle x + 1.5, over a block at 2 … 4 of depth 4; its middle in y is 2.
    bins = stack((7, 4, 6), (2, 0, 0, 2, 4, 2))
    free = ask(rule, bins, (3, 4, 1))[:5, 0].tolist()
    assert free == [False, True, True, False, True]  # middles 2.5 and 3.5, half a cell inside
    assert ask(rule, bins, (3, 4, 1), margin=0.4)[:5, 0].tolist() == free
    assert ask(rule, bins, (3, 4, 1), margin=0.5)[:5, 0].tolist() == [False] * 4 + [True]
    assert not ask(rule, bins, (3, 4, 1), margin=1.5).any()  # half of the box itself


def test_the_margin_of_equilibrium_is_a_disc_and_holds_for_the_boxes_below() -> None:
    # A plate of 11 x 11 on four pillars; the side of their hull runs from (11, 1) to (9, 11), on
    # 5 x + y = 56. The heavy item's middle (8, 6) is 10 / √26 = 1.961 cells from it. That side's
    # normal lies between two of the directions in which the centre of mass is tried.
    pillars = [(x, y, 0, 1, 1, 1) for x, y in ((0, 0), (0, 10), (10, 0), (8, 10))]
    bins = stack((11, 11, 9), *pillars, (0, 0, 1, 11, 11, 1))
    weights = {"weights": [1, 1, 1, 1, 0.1], "weight": 100.0}
    for margin, stands in ((1.9, True), (1.98, False)):
        assert ask("equilibrium", bins, (4, 4, 1), margin=margin, **weights)[6, 4] == stands
        assert not ask("hull_alpha", bins, (4, 4, 1), margin=margin)[6, 4]
        assert ask("hull_1", bins, (4, 4, 1), margin=margin)[6, 4]


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_can_be_bound_beforehand(rule: str) -> None:
    bins = stack((4, 4, 6), (0, 0, 0, 2, 2, 2))
    expected = ask(rule, bins, (2, 2, 2))
    got = stable_mask(
        make_rule(rule), bins.heightmap[0], bins.empty_map[0], [2, 2, 2], 6, boxes_of(bins, 0)
    )
    assert (got == expected).all()


def test_equilibrium_does_not_trust_a_stack_that_already_falls() -> None:
    # The upper box hangs past its edge; a box elsewhere changes nothing, one on its end holds it.
    #   U U U U .
    #   A . . . .
    boxes = np.array([(0, 0, 0, 1, 1, 2), (0, 0, 2, 4, 1, 1)])
    heights, gaps = (
        np.array([[3], [3], [3], [3], [0], [0]]),
        np.array([[0], [2], [2], [2], [0], [0]]),
    )
    assert not in_equilibrium(boxes)
    mask = stable_mask("equilibrium", heights, gaps, (1, 1, 1), 60, boxes)
    assert not mask.any()
    # Half of the plank's weight 4 pulls at x = 2, one cell past the edge; 9 at 0.5 holds it back.
    mask = stable_mask("equilibrium", heights, gaps, (1, 1, 1), 60, boxes, weight=9.0)
    assert mask[:, 0].tolist() == [True, False, False, False, False, False]


def test_a_bound_rule_is_checked_like_a_named_one() -> None:
    boxes = np.array([(0, 0, 0, 1, 4, 2), (0, 0, 2, 5, 4, 1)])  # falls
    heights, gaps = np.zeros((6, 4), int), np.zeros((6, 4), int)
    heights[:5], gaps[1:5] = 3, 2
    for rule in ("equilibrium", make_rule("equilibrium")):
        assert not stable_mask(rule, heights, gaps, (1, 1, 1), 8, boxes).any()
    for name in ("lbcp", "equilibrium"):
        with pytest.raises(ValueError, match="give boxes"):
            stable_mask(make_rule(name), heights, gaps, (1, 1, 1), 8)
    with pytest.raises(ValueError, match="need the name of a rule"):
        stable_mask(make_rule("hull_1"), heights, gaps, (1, 1, 1), 8, margin=1.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"rule": "hull"}, "unknown stability rule"),
        ({"margin": -1.0}, "margin"),
        ({"margin": True}, "margin"),
        ({"margin": float("nan")}, "margin"),
        ({"thresholds": "paper"}, "no parameter 'thresholds'"),
        ({"item": (2, 2)}, "item"),
        ({"item": (2, 0, 2)}, "item"),
        ({"item": (2, 2.5, 2)}, "item"),
        ({"heightmap": [[0.5, 0], [0, 0]]}, "heightmap"),
        ({"heightmap": [[float("nan"), 0], [0, 0]]}, "heightmap"),
        ({"heightmap": [[7, 0], [0, 0]]}, "heights must lie in 0 … 6"),
        ({"heightmap": [0, 0]}, "same shape"),
        ({"empty_map": [[1, 0], [0, 0]]}, "empty_map"),
        ({"empty_map": None}, "empty_map: needs .* zeros if every column is filled"),
        ({"bin_height": 0}, "bin size"),
        ({"com_offset": (0.5, 0, 0)}, "com_offset"),
        ({"weight": -2.0}, "weight"),
        ({"boxes": [[0, 0, 1, 1, 1, 1]]}, "row 0 .*floats"),
        ({"boxes": [[0, 0, 0, 3, 1, 1]]}, "row 0 .*outside"),
        ({"boxes": [[0, 0, 0, 1, 1, 1]]}, "do not lead to this heightmap"),
        ({"weights": [1.0]}, "weights"),
    ],
)
def test_impossible_arguments_are_refused(change: dict[str, object], why: str) -> None:
    arguments: dict[str, object] = {
        "rule": "hull_alpha",
        "heightmap": np.zeros((2, 2)),
        "empty_map": np.zeros((2, 2)),
        "item": (1, 1, 1),
        "bin_height": 6,
    }
    with pytest.raises(ValueError, match=why):
        stable_mask(**(arguments | change))


@pytest.mark.parametrize("rule", ["lbcp", "equilibrium"])
def test_rules_of_the_whole_stack_need_its_boxes(rule: str) -> None:
    with pytest.raises(ValueError, match="give boxes"):
        stable_mask(rule, np.ones((2, 2)), np.zeros((2, 2)), (1, 1, 1), 6)


def test_boxes_may_come_in_any_order() -> None:
    bins = stack((6, 2, 9), (0, 0, 0, 1, 2, 2), (4, 0, 0, 1, 2, 2), (0, 0, 2, 5, 2, 1))
    maps = bins.heightmap[0], bins.empty_map[0]
    mask = stable_mask("lbcp", *maps, (2, 2, 2), 9, boxes_of(bins, 0)[::-1])
    assert (mask == ask("lbcp", bins, (2, 2, 2))).all()


def test_masks_are_plain_boolean_arrays() -> None:
    mask = stable_mask("hull_alpha", torch.zeros(3, 3), torch.zeros(3, 3), [1, 1, 1], 5)
    assert isinstance(mask, np.ndarray)
    assert mask.dtype == np.bool_
    assert mask.shape == (3, 3)
