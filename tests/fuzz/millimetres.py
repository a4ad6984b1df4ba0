"""Games in millimetres at random: every packing is checked by plain code that shares nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack import ExactPacking
from marl_pack.exact.policies import make_exact_policy
from marl_pack.stability.static_equilibrium import in_equilibrium

Generator = np.random.Generator
SOUND = ("hull_alpha", "lbcp", "equilibrium")


def random_options(generator: Generator) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return options of a game, and goods for it: round or odd sizes, a few or many boxes."""
    unit = float(generator.choice([0.1, 1.0, 10.0]))
    longest = int(generator.choice([6, 10, 40, 1000, 100_000]))
    size = generator.integers(longest // 2 + 1, longest + 1, 3)
    coarse = max(1, longest // int(generator.choice([6, 10, 1000])))  # round sizes meet at corners
    count = int(generator.choice([10, 30, 70, 140]))
    share = float(generator.choice([0.3, 0.5, 1.0]))
    sides = generator.integers(1, np.maximum(2, (size * share).astype(np.int64) + 1), (count, 3))
    sides = np.minimum(np.maximum(coarse, sides // coarse * coarse), size.min())
    rule = str(generator.choice([*SOUND, "hull_1", "area_ratio", "none"]))
    options: dict[str, Any] = {
        "bin_mm": (size * unit).round(6).tolist(), "unit_mm": unit, "rule": rule,
        "max_boxes": count,
    }  # fmt: skip
    if rule in (*SOUND, "hull_1") and generator.random() < 0.4:
        options["margin_mm"] = round(float(generator.uniform(0, size.min() / 4) * unit), 3)
    if generator.random() < 0.3:
        gap = int(generator.integers(0, max(1, size[:2].min() // 8) + 1))
        gap = min(gap, int(size[:2].min() - sides.max()) // 2)
        options["clearance_mm"] = round(max(0, gap) * unit, 6)
    if generator.random() < 0.2:
        options["max_overhang"] = float(generator.choice([0.1, 0.25, 0.5]))
    goods: dict[str, Any] = {"items": (sides * unit).round(6)}
    if generator.random() < 0.6:
        goods["weights"] = 10.0 ** generator.uniform(-1, 2, count)
        if generator.random() < 0.5:
            goods["max_load"] = 10.0 ** generator.uniform(0, 3, count)
            goods["stackable"] = generator.random(count) < 0.8
            options["max_weight_kg"] = float(10.0 ** generator.uniform(1, 4))
    return options, goods


def check_packing(game: ExactPacking) -> None:
    """Raise AssertionError unless the bin of one game holds what its options allow."""
    spec, boxes = game.spec, game.bins.boxes(0)
    rows = game.rows[0, : len(boxes)]
    goods, size = game.stream.goods[rows], np.array(spec.size)
    gap = round(spec.clearance_mm / spec.unit_mm)
    low, high = boxes[:, :3], boxes[:, :3] + boxes[:, 3:]
    assert (low >= (gap, gap, 0)).all()
    assert (high <= size - (gap, gap, 0)).all()
    assert (np.sort(boxes[:, 3:]) == np.sort(goods.sides)).all()
    above: list[set[int]] = []  # the boxes that carry each box, through every contact
    for i in range(len(boxes)):
        shared = np.minimum(high[i], high[:i]) - np.maximum(low[i], low[:i])
        flat = (shared[:, :2] > 0).all(1)
        assert not (flat & (shared[:, 2] > 0)).any(), "overlap"
        assert not (flat & (low[:i, 2] >= high[i, 2])).any(), "placed under a box"
        # Whatever is higher than the bottom of the box keeps its distance.
        near = (shared[:, :2] > -gap).all(1) & ~flat & (high[:i, 2] > low[i, 2])
        assert gap == 0 or not near.any(), "clearance"
        on = np.flatnonzero(flat & (high[:i, 2] == low[i, 2])).tolist()
        assert on or low[i, 2] == 0, "floats"
        assert goods.stackable[on].all(), "stackable"
        above.append(set(on).union(*(above[j] for j in on)))
    weights = np.where(np.isnan(goods.weights), 0, goods.weights)
    loads = np.zeros(len(boxes))
    for i, carriers in enumerate(above):
        loads[list(carriers)] += weights[i]
    assert (loads <= goods.max_load * (1 + 1e-9)).all(), "max_load"
    if spec.max_weight_kg is not None:
        assert weights.sum() <= spec.max_weight_kg * (1 + 1e-9), "max_weight_kg"


def check_equilibrium(boxes: NDArray[np.int64], rule: str, generator: Generator) -> None:
    """Raise AssertionError unless a stack placed by a sound rule stands, for any weights."""
    if rule in ("hull_alpha", "lbcp"):
        centres = boxes[:, :2] + boxes[:, 3:5] / 2
        weights = 10.0 ** generator.integers(-2, 3, len(boxes))
        assert in_equilibrium(boxes, np.column_stack((weights, centres))), "falls"


def case_of(seed: list[int]) -> None:
    """Play one game and check it after each placement, and its statics at the end.

    Raises:
        ValueError: if the options refuse the goods.
        AssertionError: if the packing breaks a limit or does not stand.
    """
    generator = np.random.default_rng(seed)
    options, goods = random_options(generator)
    game = ExactPacking(1, goods, auto_reset=False, **options)
    policy = make_exact_policy(str(generator.choice(["random", "random", "max_contact", "dblf"])),
                               int(generator.integers(1 << 30)))  # fmt: skip
    while game.alive.any():
        moves = policy(game)
        assert moves[0] in game.moves.of(0)
        game.place(moves)
        assert not game.alive.any() or len(game.moves.of(0))
    check_packing(game)
    boxes = game.bins.boxes(0)
    if len(boxes) <= 40:
        check_equilibrium(boxes, game.spec.rule, generator)
        known = game.bins.state.weights[0, : len(boxes)]
        centres = boxes[:, :2] + boxes[:, 3:5] / 2
        if game.spec.rule == "equilibrium":
            assert in_equilibrium(boxes, np.column_stack((known, centres))), "falls"


def cases(seed: int) -> Iterator[tuple[str, Callable[[], None]]]:
    """Yield games without end: a name, and a function that plays and checks one."""
    for part in range(10**9):
        yield f"game {seed}-{part}", lambda part=part: case_of([seed, part])
