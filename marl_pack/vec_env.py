"""N bins as a vectorized environment of rsl_rl.

Each step of the game has two turns. ``get_observations`` shows the first, the orientation agent's;
``orient`` shows the second, the placement agent's; ``step`` takes both choices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from marl_pack.agents import joint, orientation, placement
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.game.packing import Packing


class PackingVecEnv(VecEnv):
    """A game with ``auto_reset`` as rsl_rl's runner drives it.

    Args:
        game: N bins.
        planes: extra planes for each agent (:data:`marl_pack.agents.networks.trunk.PLANES`), by its
        name.
            With the key ``joint``, the first turn is the joint agent's and there is no second.
        cfg: the run's settings, for the logger: an object with ``to_dict``.

    Raises:
        ValueError: if the game does not begin new episodes by itself.
    """

    def __init__(
        self, game: Packing, planes: Mapping[str, Sequence[str]], cfg: object = None
    ) -> None:
        if not game.auto_reset:
            raise ValueError("a game for training needs auto_reset=True")
        self.game, self.planes = game, dict(planes)
        self.num_envs, self.num_actions = game.n, 2
        self.device = game.device
        self.cfg = {} if cfg is None else cfg
        self.max_episode_length = game.bins.boxes.shape[1]
        # Who says what placements are worth to agents that see it; PackingPPO teaches it.
        self.afterstates: AfterstateCritic | None = None
        if any("worth" in seen for seen in self.planes.values()):
            self.afterstates = AfterstateCritic().to(self.device)
        self._heightmap: Tensor | None = None  # the copy that this step's observations share

    @property
    def episode_length_buf(self) -> Tensor:
        """Items placed in each bin, int64 [N]."""
        return self.game.t

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        raise ValueError("an episode cannot begin in its middle: leave init_at_random_ep_len False")

    def get_observations(self) -> TensorDict:
        """What the first agent sees: groups as :func:`marl_pack.agents.orientation.observe`."""
        if "joint" in self.planes:
            seen = joint.observe(self.game, self.planes["joint"], self.afterstates)
        else:
            planes = self.planes.get("orientation", ())
            seen = orientation.observe(self.game, planes, self.afterstates)
        self._heightmap = seen["heightmap"]
        return TensorDict(seen, batch_size=[self.num_envs], device=self.device)

    def look_again(self, seen: TensorDict) -> None:
        """Write into ``seen`` what is seen now that the critic of afterstates has learned."""
        if self.afterstates is not None:
            self.game.forget(self.afterstates)
            with torch.inference_mode():
                seen.update_(self.get_observations())

    def orient(self, chosen: Tensor) -> TensorDict:
        """What the placement agent sees: groups as :func:`marl_pack.agents.placement.observe`.

        Args:
            chosen: int64 [N], the orientations. Nothing changes: it may be called again.
        """
        seen = placement.observe(
            self.game, self.planes.get("placement", ()), chosen, self._heightmap, self.afterstates
        )
        return TensorDict(seen, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Set the items down.

        Args:
            actions: int64 [N, 2], orientation and cell, taken from the masks.

        Returns:
            The next observation, rewards float32 [N] (Eq. 5), dones uint8 [N] and extras: ``log``
            holds utilization and items of the episodes that have ended.
        """
        outcome = self.game.place(actions[:, 0], actions[:, 1], check=False)
        ended = outcome.done.nonzero().squeeze(1)
        log = {}
        if len(ended):
            log = {
                "Train/utilization": outcome.utilization[ended].float(),
                "Train/items": outcome.placed[ended].float(),
            }
        return self.get_observations(), outcome.reward, outcome.done.byte(), {"log": log}
