"""Explain the placements of a policy in millimetres: the listed moves, and what it computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.bins import placements
from marl_pack.exact.lengths import to_mm
from marl_pack.explanation import PROBABILITY_OF, Explanation


@dataclass(frozen=True)
class Reasons:
    """What a policy computed for the M legal moves of one game; None where it did not."""

    values: NDArray[np.float64] | None = None  # [M]  the highest is the best; NaN: not computed
    value_of: str = ""  # what the values are
    orientation_probabilities: NDArray[np.float64] | None = None  # [6]
    probabilities: NDArray[np.float64] | None = None  # [M]  NaN in other orientations
    tries: NDArray[np.int64] | None = None  # [M]  number of futures behind each value
    probability_of: str = PROBABILITY_OF[0]


@runtime_checkable
class Explained(Protocol):
    """A policy that says what it computed."""

    def reasons(self, game: Any, g: int, moves: NDArray[np.int64], move: int) -> Reasons:
        """Return what it computed for the legal moves, int64 [M], of game ``g``.

        Args:
            game: the games, before the placement.
            g: number of the game.
            moves: int64 [M], its legal moves.
            move: its choice.
        """


def explain(policy: Any, game: Any, g: int, move: int, in_mm: bool = True) -> Explanation:
    """Explain a policy's choice in one game.

    Args:
        policy: the policy; a policy without a method ``reasons`` gets the legal moves alone.
        game: the games (:class:`marl_pack.exact.packing.ExactPacking`), before the placement.
        g: number of the game.
        move: its choice.
        in_mm: whether lengths are in millimetres, as in plans of the packer; if not, they are in
            units, as in plans of games.
    """
    moves = game.moves.of(g)
    reasons = policy.reasons(game, g, moves, move) if isinstance(policy, Explained) else Reasons()
    where, chosen = placements(moves), np.flatnonzero(moves == move)
    corners = where[:, 1:]
    return Explanation(
        len(moves),
        int(chosen[0]) if len(chosen) else -1,
        where[:, 0],
        np.asarray(to_mm(corners, game.spec.unit_mm) if in_mm else corners, np.float64),
        reasons.orientation_probabilities,
        reasons.probabilities,
        reasons.values,
        reasons.value_of,
        reasons.tries,
        reasons.probability_of,
    ).shortened()
