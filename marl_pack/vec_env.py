"""G games as a vectorized environment of rsl_rl."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any

from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.selection_state import SelectionOutcome
from marl_pack.game.state import Copied
from marl_pack.game.turns import Outcome


class EndedEpisodes(Mapping[str, Tensor]):
    """The figures of the episodes that ended in a step; without such episodes it is empty.

    They are selected when the logger reads them, so that no step waits for their number.
    """

    def __init__(self, outcome: Outcome | SelectionOutcome) -> None:
        self._outcome = outcome

    @cached_property
    def _figures(self) -> dict[str, Tensor]:
        ended = self._outcome.done.nonzero().squeeze(1)
        if not len(ended):
            return {}
        return {
            "Train/utilization": self._outcome.utilization[ended].float(),
            "Train/items": self._outcome.placed[ended].float(),
        }

    def __getitem__(self, name: str) -> Tensor:
        return self._figures[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._figures)

    def __len__(self) -> int:
        return len(self._figures)


class PackingVecEnv(Copied, VecEnv):
    """G games with ``auto_reset`` as an environment for rsl_rl's runner; one item in each step.

    A step of the game has two turns, or three where a box and a bin are selected first. The runner
    sees the observation of the first turn. Those of the later turns depend on earlier choices, so
    the algorithm gets them from the game.

    Args:
        game: the games.
        observe: a function that returns the observation of the first turn in these games.
        cfg: the run's settings, for the logger: an object with ``to_dict``.

    Raises:
        ValueError: if the games do not restart by themselves.
    """

    def __init__(
        self,
        game: Packing | SelectionPacking,
        observe: Callable[[Any], Mapping[str, Tensor]],
        cfg: object = None,
    ) -> None:
        if not game.auto_reset:
            raise ValueError("a game for training needs auto_reset=True")
        self.game, self.observe = game, observe
        selects = isinstance(game, SelectionPacking)
        self.num_envs, self.num_actions = game.n, 3 if selects else 2
        self.device = game.device
        self.cfg = {} if cfg is None else cfg
        bins = game.b + game.spec.most_closings - 1 if isinstance(game, SelectionPacking) else 1
        self.max_episode_length = game.bins.boxes.shape[1] * bins

    @property
    def episode_length_buf(self) -> Tensor:
        """Number of items placed in each game's episode, int64 [G]."""
        game = self.game
        return game.state.placed if isinstance(game, SelectionPacking) else game.t

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        raise ValueError("an episode cannot begin in its middle: leave init_at_random_ep_len False")

    def get_observations(self) -> TensorDict:
        """Return the observation of the agent that acts first."""
        observation = dict(self.observe(self.game))
        return TensorDict(observation, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Place the visible item of each game.

        Args:
            actions: int64 [G, 2], orientation and cell, or [G, 3], option, orientation and cell,
                taken from the masks.

        Returns:
            The next observation, rewards float32 [G] (Eq. 5), dones uint8 [G] and extras: ``log``
            has the utilization and number of items of the episodes that have ended
            (:class:`EndedEpisodes`); in games with selection, ``closed`` bool [G, b] says which
            bins were closed.

        Raises:
            ValueError: unless the actions have this shape.
        """
        if actions.shape != (self.num_envs, self.num_actions):
            shape = [self.num_envs, self.num_actions]
            raise ValueError(f"actions {list(actions.shape)}: need int64 {shape}")
        outcome = self.game.place(*actions.unbind(1), check=False)
        extras: dict[str, Any] = {"log": EndedEpisodes(outcome)}
        if isinstance(outcome, SelectionOutcome):
            extras["closed"] = outcome.emptied
        return self.get_observations(), outcome.reward, outcome.done.byte(), extras
