"""The policies that clients may choose, by name."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from marl_pack import published, renamed
from marl_pack.checks import shown
from marl_pack.exact.explaining import Reasons
from marl_pack.exact.search_settings import ExactSearchSettings
from marl_pack.exact.spec import ExactSpec
from marl_pack.packer.policies import (
    PACKER_POLICIES,
    SEARCH,
    PackerPolicy,
    make_packer_policy,
)
from marl_pack.packer.turn import Turn


@dataclass(frozen=True)
class _OneAtATime:
    """A policy that several bins share; it serves one of them at a time."""

    policy: PackerPolicy
    lock: threading.Lock

    def __call__(self, turn: Turn) -> NDArray[np.int64]:
        """Return the move of the visible box, int64 [1]."""
        with self.lock:
            return self.policy(turn)

    def reasons(self, turn: Turn, g: int, moves: NDArray[np.int64], move: int) -> Reasons:
        """Return what the policy computed (:class:`marl_pack.exact.explaining.Explained`).

        It computes it again, as other bins may have asked it since.
        """
        if not hasattr(self.policy, "reasons"):
            return Reasons()
        with self.lock:
            self.policy(turn)
            reasons: Reasons = self.policy.reasons(turn, g, moves, move)
            return reasons


class Policies:
    """The policies that clients may choose. A client can name no file.

    Args:
        others: policies that the server allows besides the built-in ones: .json files of
            ``marl-pack tune``, runs, checkpoints, or FILE.py:NAME. Clients name them as they are
            written here.
        max_budget_ms: largest time budget of a search.

    Raises:
        ValueError, FileNotFoundError: if one of the others cannot be loaded.
    """

    def __init__(self, others: Sequence[str], max_budget_ms: float) -> None:
        self.names = tuple(dict.fromkeys((*PACKER_POLICIES, *published.models(), *others)))
        self.max_budget_ms = max_budget_ms
        # Those that take long to load, as long as a bin uses them.
        self._shared: WeakValueDictionary[Any, _OneAtATime] = WeakValueDictionary()
        self._lock = threading.Lock()
        self._loaded = [self.make(name, ExactSpec(), None, None, 0) for name in others]

    def make(
        self, name: str, spec: ExactSpec, plan: str | None, grid_mm: float | None, seed: int
    ) -> PackerPolicy:
        """Return the policy of a bin.

        Raises:
            ValueError, FileNotFoundError: if clients may not choose it, or an argument does not
                belong to it; says what would be right.
        """
        if name not in self.names:
            raise ValueError(
                f"policy {shown(name)}: needs one of {', '.join(self.names)}"
                f"{renamed.guess(name, self.names)}"
            )
        searches = name == SEARCH or plan is not None
        if searches:
            settings = ExactSearchSettings() if plan is None else ExactSearchSettings.parse(plan)
            if settings.budget_ms > self.max_budget_ms:
                raise ValueError(
                    f"plan: a budget of {settings.budget_ms:g} ms; this server allows at most "
                    f"{self.max_budget_ms:g} ms (max_budget_ms)"
                )
        if searches or name in PACKER_POLICIES:
            return make_packer_policy(name, spec, plan=plan, grid_mm=grid_mm, seed=seed)
        key = (name, spec, grid_mm, seed)
        with self._lock:
            shared = self._shared.get(key)
            if shared is None:
                policy = make_packer_policy(name, spec, grid_mm=grid_mm, seed=seed)
                shared = self._shared[key] = _OneAtATime(policy, threading.Lock())
            return shared
