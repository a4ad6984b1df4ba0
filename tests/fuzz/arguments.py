"""Wrong arguments of the public functions, at random."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

import marl_pack
from marl_pack import SearchSettings, stable_place
from marl_pack.env_aec import raw_env
from marl_pack.stability import in_equilibrium, make_rule, stable_mask

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, 5, -1, 2.5, 1.0, float("nan"), float("inf"), 10**400, 2**63, 2**31,
    "1", "", "hull", "\x1b[31m", [], {}, [1, 2], (1, 2, 3), [[1, 2, 3]], [[2, 2, [1]]], [True] * 3,
    (True, 2, 1),
    ["1", "2", "3"], np.array([1, 2, 3], np.uint8), np.array([0.5] * 3), np.array("x"),
    np.ma.array([1, 2, 3], mask=[0, 0, 1]), np.float32(0.1), np.int8(3), torch.tensor(3),
    torch.tensor([1, 2, 3]), object(), b"1", 1j, range(3), {1: 2}, float, -0.0, 1e-300,
)  # fmt: skip
"""Values that stand for any argument."""

FLOOR = np.zeros((4, 5), np.int64)
BOXES = np.array([[0, 0, 0, 2, 2, 1]])


def _stack() -> dict[str, Any]:
    heights = FLOOR.copy()
    heights[:2, :2] = 1
    return {"heightmap": heights, "empty_map": FLOOR.copy(), "item": (2, 3, 1), "bin_height": 6}


def _play(**options: Any) -> None:
    """Play two turns with a game of these options."""
    games = marl_pack.Packing(**options)
    policy = marl_pack.load("dblf")
    for _ in range(2):
        games.place(*policy(games))


def _play_exact(**options: Any) -> None:
    """Play two turns with a game in millimetres of these options."""
    games = marl_pack.ExactPacking(**options)
    policy = marl_pack.make_exact_policy("max_contact")
    for _ in range(2):
        games.place(policy(games))


def _move_exact(moves: Any) -> None:
    marl_pack.ExactPacking(2, [[30, 20, 10]]).place(moves)


def _step(action: Any, **options: Any) -> None:
    env = raw_env(**options)
    env.reset(seed=1)
    env.step(action)


def _reset(**arguments: Any) -> None:
    env = raw_env()
    env.reset(**arguments)
    env.step(0)


def _place(orientation: Any, cell: Any) -> None:
    games = marl_pack.Packing(2)
    games.place(orientation, cell)


GAME: dict[str, Any] = {
    "bin": (6, 5, 7), "rule": "hull_alpha", "margin": 0.5, "com_offset": (0.1, 0.0, 0.0),
    "orientations": (0, 1), "mask_orientations": True, "alpha": 1.0, "beta": 0.1,
    "max_items": 9,
}  # fmt: skip
CALLS: dict[str, tuple[Callable[..., Any], Callable[[], dict[str, Any]]]] = {
    "stable_mask hull": (
        stable_mask,
        lambda: {"rule": "hull_alpha", **_stack(), "com_offset": (0.1, 0.2, 0), "margin": 0.1},
    ),
    "stable_mask area": (
        stable_mask,
        lambda: {"rule": "area_ratio", **_stack(), "thresholds": [(0.5, 3), (0.9, 0)]},
    ),
    "stable_mask equilibrium": (
        stable_mask,
        lambda: {
            "rule": "equilibrium", **_stack(), "boxes": BOXES.copy(), "weights": [2.5],
            "weight": 0.5, "com_offset": (0.1, 0.2, 0), "check_stack": True,
        },
    ),
    "in_equilibrium": (
        in_equilibrium,
        lambda: {"boxes": np.array([[0, 0, 0, 2, 2, 1], [0, 1, 1, 2, 2, 1]]),
                 "loads": [[1.0, 1.0, 1.0], [2.0, 1.0, 1.9]]},
    ),
    "make_rule": (make_rule, lambda: {"name": "hull_1", "margin": 0.5}),
    "Packing": (_play, lambda: {"n": 2, "seed": 1, **GAME, "items": "rs", "sides": (2, 3)}),
    "raw_env step": (_step, lambda: {"action": 0, "bin_size": (6, 5, 7), "sides": (2, 3)}),
    "reset": (_reset, lambda: {"seed": 1, "options": {"items": [[2, 2, 2], [3, 3, 3]]}}),
    "place": (_place, lambda: {"orientation": torch.tensor([0, 0]), "cell": torch.tensor([0, 0])}),
    "heuristic": (marl_pack.load, lambda: {"source": "random", "seed": 1, "device": "cpu"}),
    "model": (
        marl_pack.load,
        lambda: {"source": "rs", "seed": 1, "symmetric": True, "search": SearchSettings(2, 3)},
    ),
    "stable_place": (
        stable_place,
        lambda: {"item": [30, 20, 10], "boxes": [[0, 0, 0, 40, 30, 20]], "at": (5, 0),
                 "attributes": {"weights": [2.0], "max_load": [9.0]}, "bin_mm": (60, 50, 90),
                 "margin_mm": 2, "rule": "lbcp", "orientations": (0, 1)},
    ),
    "ExactPacking": (
        _play_exact,
        lambda: {"n": 2, "items": {"items": [[30, 20, 10], [20, 20, 20.5]], "weights": [1, 2],
                                   "ids": ["a", 7], "upright": [True, False]},
                 "order": "draw", "length": 4, "seed": 3, "bin_mm": (60, 50, 90),
                 "clearance_mm": 1, "level_tolerance_mm": 0.5, "max_boxes": 8},
    ),
    "move": (_move_exact, lambda: {"moves": np.array([1, 2])}),
    "rows": (
        _play,
        lambda: {"n": 2, "seed": 1, "items": {"items": [[[2, 2, 2], [3, 3, 3]]],
                                              "weights": [[1.0, 2.0]]}},
    ),
}  # fmt: skip
"""Name → a function and arguments that are right."""


def cases(seed: int) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield calls with one wrong or unusual argument, without end.

    Yields:
        A name of the case, and a function that makes the call.
    """
    generator = random.Random(seed)
    while True:
        name = generator.choice(list(CALLS))
        function, right = CALLS[name]
        arguments = right()
        key = generator.choice(list(arguments))
        value = generator.choice(VALUES)
        place = key
        inside = arguments[key]
        if isinstance(inside, list | tuple | dict) and inside and generator.random() < 0.5:
            inside = copy.deepcopy(inside)
            index = generator.choice(
                list(inside) if isinstance(inside, dict) else range(len(inside))
            )
            place = f"{key}[{index!r}]"
            if isinstance(inside, tuple):
                inside = (*inside[:index], value, *inside[index + 1 :])
            else:
                inside[index] = value
            arguments[key] = inside
        else:
            arguments[key] = value
        yield (
            f"{name}: {place} = {value!r:.40}",
            lambda function=function, arguments=arguments: function(**arguments),
        )
