"""Random games that are played in the mode that compares every placement with plain code."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator
from typing import Any

import torch

from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.keys import POLICIES
from marl_pack.backend import Backend
from marl_pack.game.invariants import VARIABLE
from marl_pack.game.packing import Packing
from marl_pack.stability import RULES

TURNS = 6


def options(generator: random.Random) -> dict[str, Any]:
    """Return random options of a game, all of them right."""
    rule = generator.choice(list(RULES))
    longest = 4 if rule == "equilibrium" else 6  # its plain code solves a program for every window
    size = tuple(generator.randint(2, longest) for _ in range(3))
    chosen: dict[str, Any] = {
        "bin": size, "rule": rule, "sides": (1, generator.randint(1, min(size))),
        "items": generator.choice(["rs", "cut1", "cut2"]),
        "orientations": tuple(sorted(generator.sample(range(6), generator.randint(1, 6)))),
        "mask_orientations": generator.random() < 0.7,
        "max_items": generator.choice([None, None, 3]),
        "auto_reset": generator.random() < 0.5,
        "backend": generator.choice(list(Backend)),
        "seed": generator.randrange(2**32),
    }  # fmt: skip
    if rule not in ("area_ratio", "none") and generator.random() < 0.5:
        chosen["margin"] = generator.choice([0.1, 0.25, 0.3, 0.5])
    if generator.random() < 0.5:
        chosen["com_offset"] = tuple(round(generator.uniform(-0.4, 0.4), 2) for _ in range(3))
    if rule == "area_ratio" and generator.random() < 0.5:
        chosen["thresholds"] = "code"
    if generator.random() < 0.4:
        chosen["items"] = _goods(generator, size)
        del chosen["sides"]
    return chosen


def _goods(generator: random.Random, size: tuple[int, ...]) -> dict[str, Any]:
    """Return items with attributes, in the form of a JSON file."""
    lengths = [generator.randint(1, 8) for _ in range(generator.randint(2, 6))]

    def each(make: Callable[[], Any]) -> list[list[Any]]:
        return [[make() for _ in range(length)] for length in lengths]

    most = min(size)
    return {
        "items": each(lambda: [generator.randint(1, most) for _ in range(3)]),
        "weights": each(lambda: round(generator.uniform(0.1, 9), generator.randint(1, 9))),
        "upright": each(lambda: generator.random() < 0.3),
        "ids": each(lambda: generator.randint(0, 99)),
    }


def cases(seed: int) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield games, without end: a name, and a function that plays one."""
    generator = random.Random(seed)
    while True:
        chosen = options(generator)
        policy = generator.choice(list(POLICIES))
        yield f"{policy} {chosen}", lambda chosen=chosen, policy=policy: play(policy, chosen)


def play(policy: str, chosen: dict[str, Any]) -> str:
    """Play some turns, from a branch and from a copied state too.

    Raises:
        AssertionError: for the first difference from plain code.
        ValueError: if the options contradict each other, such as items that fit nowhere.
    """
    os.environ[VARIABLE] = "1"
    player, games = make_policy(policy, seed=1), Packing(2, **chosen)
    assert games.checked
    for turn in range(TURNS):
        if turn == TURNS // 2:
            games.load_state_dict(games.state_dict())
            branch = games.branch(torch.tensor([1, 0]))
            branch.place(*player(branch))
        if not bool(games.alive.any()):
            break
        games.place(*player(games))
    return "right"
