"""Heuristics on listed moves, and the linear score with weights from a file.

A policy is called with a game and returns the move of each game, int64 [G]; NOWHERE where the
visible box has no place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from marl_pack import renamed
from marl_pack.checks import LARGEST_SEED, real_number, shown, whole_number
from marl_pack.exact.bins import NOWHERE
from marl_pack.exact.choice import BEST_FIT, DBLF, HEIGHT_MIN, LINEAR
from marl_pack.exact.explaining import Reasons
from marl_pack.exact.features import FEATURES
from marl_pack.inputs import read_json
from marl_pack.items.names import check_names

if TYPE_CHECKING:
    from marl_pack.exact.packing import ExactPacking

LARGEST_WEIGHT = 1e9
"""Largest weight of a feature."""
TUNED = Path(__file__).with_name("linear.json")
"""Weights of the policy ``linear`` that come with the package (docs/millimetres.md)."""


class ExactPolicy(Protocol):
    """A function that chooses a move in each game."""

    def __call__(self, game: ExactPacking) -> NDArray[np.int64]:
        """Return the moves, int64 [G]."""


@dataclass(frozen=True)
class Scored:
    """A policy that takes the legal move with the highest score; of equal moves the first one.

    Args:
        kind: a score of :mod:`marl_pack.exact.choice`.
        weights: weights of the features, float64 [F], for the score LINEAR.
    """

    kind: int
    weights: NDArray[np.float64]

    def __call__(self, game: ExactPacking) -> NDArray[np.int64]:
        """Return the best move of each game, int64 [G]."""
        return game.bins.best(game.items, self.kind, self.weights, game.alive)

    def reasons(self, game: Any, g: int, moves: NDArray[np.int64], move: int) -> Reasons:
        """Return the linear score of each move (:class:`marl_pack.exact.explaining.Explained`)."""
        if self.kind != LINEAR:
            return Reasons()
        return Reasons(game.bins.features(g, game.items.sides[g], moves) @ self.weights, "score")


@dataclass(frozen=True)
class RandomMoves:
    """A policy that draws one of the legal moves, all with equal probability.

    Args:
        generator: of random numbers.
    """

    generator: np.random.Generator

    def __call__(self, game: ExactPacking) -> NDArray[np.int64]:
        """Return the drawn move of each game, int64 [G]."""
        listed = game.moves
        counts = listed.counts
        index = (self.generator.random(len(counts)) * counts).astype(np.int64)
        numbers = np.append(listed.numbers, NOWHERE)
        return np.where(counts > 0, numbers[listed.starts[:-1] + index], NOWHERE)


def linear_weights(weights: Mapping[str, float]) -> NDArray[np.float64]:
    """Return the weights of all features, float64 [F]; a feature that is not named has weight 0.

    Raises:
        ValueError: for an unknown feature or a weight that is not a finite number.
    """
    check_names(weights, tuple(FEATURES), (), "weights", "feature")
    vector = np.zeros(len(FEATURES))
    for name, weight in weights.items():
        number = real_number(weight, name)
        if abs(number) > LARGEST_WEIGHT:
            raise ValueError(f"{name} = {number:g}: needs a weight from -1e9 to 1e9")
        vector[list(FEATURES).index(name)] = number
    return vector


def read_weights(path: Path) -> NDArray[np.float64]:
    """Read the weights of a linear score from a JSON file that ``marl-pack tune`` wrote.

    Raises:
        ValueError: if the file is not such a file.
    """
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("weights"), dict):
        raise ValueError(f"{path}: needs an object with the key 'weights'")
    try:
        return linear_weights(content["weights"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _contact() -> NDArray[np.float64]:
    """Return weights: the share of the surface that touches, minus the height of the top."""
    return linear_weights({"bottom": 1.0, "sides": 1.0, "walls": 1.0, "top": -1.0})


NO_WEIGHTS = np.zeros(len(FEATURES))
HEURISTICS: dict[str, Callable[[], Scored]] = {
    "dblf": lambda: Scored(DBLF, NO_WEIGHTS),
    "height_min": lambda: Scored(HEIGHT_MIN, NO_WEIGHTS),
    "best_fit": lambda: Scored(BEST_FIT, NO_WEIGHTS),
    "max_contact": lambda: Scored(LINEAR, _contact()),
    "linear": lambda: Scored(LINEAR, read_weights(TUNED)),
}
"""Every heuristic by its name."""
NAMES = (*HEURISTICS, "random")
"""Names of :func:`make_exact_policy`."""


def make_exact_policy(name: Any, seed: int = 0) -> ExactPolicy:
    """Return a policy for games in millimetres.

    Args:
        name: one of :data:`NAMES`; the path of a JSON file with weights for the linear score; or a
            function.
        seed: seed of ``random``.

    Raises:
        ValueError: for an unknown name or a file that has no weights.
    """
    if callable(name):
        policy: ExactPolicy = name
        return policy
    if name == "random":
        seed = whole_number(seed, "seed", 0, LARGEST_SEED)
        return RandomMoves(np.random.default_rng(seed))
    if name in HEURISTICS:
        return HEURISTICS[name]()
    if isinstance(name, str | Path) and str(name).endswith(".json"):
        if not Path(name).is_file():
            raise FileNotFoundError(f"{name}: no such file")
        return Scored(LINEAR, read_weights(Path(name)))
    guess = renamed.guess(name, NAMES) if isinstance(name, str) else ""
    names = ", ".join(NAMES)
    raise ValueError(f"policy {shown(name)}: needs one of {names}, or a .json file{guess}")


def named_weights(weights: NDArray[np.float64]) -> dict[str, float]:
    """Return the weights of the features by name."""
    return dict(zip(FEATURES, weights.tolist(), strict=True))
