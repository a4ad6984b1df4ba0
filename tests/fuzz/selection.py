"""Random games with a buffer, a preview and several bins, played by both backends at once."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import torch

from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.keys import POLICIES
from marl_pack.agents.selection.choosing import selection_policy_of
from marl_pack.agents.selection.policies import SelectionPolicy
from marl_pack.backend import Backend
from marl_pack.evaluation.statistics import strict_equilibrium
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.spec import SelectionSpec

from .games import options

TURNS = 12
NEVER = ("mask_orientations", "com_offset", "backend", "auto_reset")
"""Options of the other game that these games refuse, or that are chosen here."""
BALANCED = ("hull_alpha", "lbcp", "equilibrium")
"""The rules under which every stack is in strict equilibrium."""


def cases(seed: int) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yield games, without end: a name, and a function that plays one."""
    generator = random.Random(seed)
    while True:
        chosen = {name: value for name, value in options(generator).items() if name not in NEVER}
        chosen |= {
            "buffer": generator.randint(1, 4), "preview": generator.randint(0, 3),
            "bins": generator.randint(1, 3), "closings": generator.choice([None, 1, 2, 5]),
        }  # fmt: skip
        policy = generator.choice(list(POLICIES))
        yield f"{policy} {chosen}", lambda chosen=chosen, policy=policy: play(policy, chosen)


def play(policy: str, chosen: dict[str, Any]) -> str:
    """Play some turns; copy the state in the middle, and check every turn.

    Raises:
        AssertionError: if a rule of the game is broken, or the backends differ.
        ValueError: if the options contradict each other, such as items that fit nowhere.
    """
    chosen = dict(chosen)
    made = {name: chosen.pop(name) for name in ("items", "sides", "seed") if name in chosen}
    spec = SelectionSpec(**chosen)
    player = selection_policy_of(make_policy(policy, seed=1))
    both = [SelectionPacking(2, spec=spec, backend=backend, **made) for backend in Backend]
    restarting = [SelectionPacking(2, spec=spec, auto_reset=True, **made) for _ in range(2)]
    try:
        _play(player, both, restarting)
    except ValueError as error:  # only options may be refused
        raise AssertionError(f"refused in the middle of a game: {error}") from error
    if chosen["rule"] in BALANCED and chosen.get("margin") is None:
        assert all(strict_equilibrium(plan) for plan in both[0].plans())
    return "right"


def _play(
    player: SelectionPolicy, both: list[SelectionPacking], restarting: list[SelectionPacking]
) -> None:
    """Play games that end, with the choices of the first, and games that begin again."""
    first, second = restarting
    for turn in range(TURNS):
        choice = player(first)
        first.place(*choice)
        if turn < TURNS // 2:
            second.place(*choice)
        else:
            second.load_state_dict(first.state_dict())
        compare(first, second)
        if bool(both[0].alive.any()):
            choice = player(both[0])
            for game in both:
                game.place(*choice)
            compare(*both)
            check(both[0])


def compare(game: SelectionPacking, other: SelectionPacking) -> None:
    """Check that two games with the same choices are equal."""
    assert torch.equal(game.selection_mask, other.selection_mask)
    assert torch.equal(game.bins.heightmap, other.bins.heightmap)
    for name in ("mask", "slots", "t", "episode", "packed", "placed", "opened", "closed", "ended"):
        assert torch.equal(getattr(game.state, name), getattr(other.state, name)), name


def check(game: SelectionPacking) -> None:
    """Check what holds in every turn."""
    # A legal option has a placement, and games that go on have a legal option.
    some = game.state.mask.flatten(2).any(2) & ~game.state.ended[:, None]
    assert torch.equal(game.selection_mask, some)
    assert torch.equal(game.alive, game.selection_mask.any(1))
    # No box is in two slots, and none that was not shown yet is in one.
    for slots, t in zip(game.state.slots.tolist(), game.state.t.tolist(), strict=True):
        filled = [slot for slot in slots if slot >= 0]
        assert len(set(filled)) == len(filled)
        assert all(slot < t for slot in filled)
    for plan, packed, opened in zip(game.plans(), game.state.packed, game.opened, strict=True):
        assert len(plan.bin_sizes) == int(opened)
        assert int(plan.sides.prod(1).sum()) == int(packed)
