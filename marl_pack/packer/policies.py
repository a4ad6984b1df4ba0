"""The policies of the packer, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack import published, renamed
from marl_pack.agents.sources import is_own, own_policy
from marl_pack.checks import shown
from marl_pack.exact.bins import NOWHERE
from marl_pack.exact.futures import Catalogue, Futures, Shown
from marl_pack.exact.policies import (
    NAMES,
    TUNED,
    RandomMoves,
    Scored,
    make_exact_policy,
    read_weights,
)
from marl_pack.exact.search import Search
from marl_pack.exact.search_settings import ExactSearchSettings
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import make_goods_stream
from marl_pack.packer.turn import Turn

SEARCH = "search"
PackerPolicy = Callable[[Turn], NDArray[np.int64]]
"""``turn -> moves``, a move for each option, int64 [G]; NOWHERE where the box has no place, or to
leave the option out."""
PACKER_POLICIES = (*NAMES, SEARCH)
"""Names of policies that need no file."""


@dataclass(frozen=True)
class SeededMoves:
    """A random option and move, which depend only on the seed and the number of the decision.

    Args:
        seed: seed of the draws.
    """

    seed: int

    def __call__(self, turn: Turn) -> NDArray[np.int64]:
        """Return a legal move for one option that has any, int64 [G]."""
        generator = np.random.default_rng((self.seed, turn.number))
        moves: NDArray[np.int64] = RandomMoves(generator)(turn)  # type: ignore[arg-type]  # a Turn has all that it reads
        options = np.flatnonzero(moves >= 0)
        if len(options) < 2:
            return moves
        return np.where(np.arange(len(moves)) == generator.choice(options), moves, NOWHERE)


def make_packer_policy(
    policy: Any,
    spec: ExactSpec,
    *,
    plan: Any = None,
    catalogue: Any = None,
    grid_mm: float | None = None,
    seed: int = 0,
) -> PackerPolicy:
    """Return a policy; the arguments are those of :class:`marl_pack.packer.packer.Packer`.

    Raises:
        ValueError, FileNotFoundError: if there is no such policy, or an argument does not belong to
            it; says what would be right.
    """
    linear = policy in (SEARCH, "linear") or (
        isinstance(policy, str | Path) and str(policy).endswith(".json")
    )
    searches = policy == SEARCH or plan is not None
    if plan is not None and not linear:
        raise ValueError(
            f"plan: needs the policy search, linear or a .json file, not {shown(policy)}"
        )
    if catalogue is not None and not searches:
        raise ValueError("catalogue: only a search draws boxes from it; give a plan")
    if grid_mm is not None and (callable(policy) or policy in PACKER_POLICIES or linear):
        raise ValueError("grid_mm: only agents trained on cells see a grid")
    if searches:
        return _search(policy, spec, plan, catalogue, seed)
    if callable(policy):
        return policy
    if policy == "random":
        return SeededMoves(seed)
    if linear or policy in NAMES:
        return make_exact_policy(policy)  # type: ignore[return-value]  # reads what a Turn has
    if isinstance(policy, str) and is_own(policy):
        return own_policy(policy)
    return _agents(policy, spec, grid_mm, seed)


def _search(policy: Any, spec: ExactSpec, plan: Any, catalogue: Any, seed: int) -> PackerPolicy:
    """Return a search with the weights of a linear score."""
    if isinstance(plan, str):
        plan = ExactSearchSettings.parse(plan)
    if plan is None:
        plan = ExactSearchSettings()
    if not isinstance(plan, ExactSearchSettings):
        raise ValueError(f"plan {shown(plan)}: needs a text such as 'budget=500ms'")
    futures: Futures = Shown()
    if catalogue is not None and hasattr(catalogue, "draw"):
        futures = catalogue
    elif catalogue is not None:
        futures = Catalogue(make_goods_stream(catalogue, spec).goods)
    if policy in (SEARCH, "linear"):
        weights = read_weights(TUNED)
    else:
        scored = make_exact_policy(policy)
        assert isinstance(scored, Scored)
        weights = scored.weights
    return Search(weights, plan, futures, seed)


def _agents(policy: Any, spec: ExactSpec, grid_mm: float | None, seed: int) -> PackerPolicy:
    """Return agents that were trained on cells."""
    if not isinstance(policy, str | Path):
        raise ValueError(f"policy {shown(policy)}: needs a name, a path or a function")
    models = published.models()
    text = str(policy)
    if text not in models and not ({"/", "."} & set(text)):
        names = (*PACKER_POLICIES, *models)
        raise ValueError(
            f"policy {shown(text)}: needs one of {', '.join(names)}, a .json file of marl-pack "
            f"tune, a run's folder, a checkpoint or FILE.py:NAME{renamed.guess(text, names)}"
        )
    from marl_pack.packer.cells import CellAgent  # slow to import

    return CellAgent(policy, spec, grid_mm, seed)
