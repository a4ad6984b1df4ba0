"""Adapt the actor-critic to RLlib (new API stack), as an RLModule."""

from __future__ import annotations

from typing import Any

import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule

from marl_pack.integrations.network import ActorCritic


class MaskedModule(TorchRLModule, ValueFunctionAPI):
    """An :class:`ActorCritic` with RLlib's interface.

    Example: ``model_config={"agent": "orientation"}``. The network reads the mask from the
    observation. RLlib's connectors get values through ``ValueFunctionAPI``.
    """

    def setup(self) -> None:
        """Make the network of the module's agent."""
        self.network = ActorCritic(self.model_config["agent"])

    def _outputs(self, batch: dict[str, Any]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return masked logits [B, n] and values [B]."""
        observation = batch[Columns.OBS]
        return self.network(observation["observation"], observation["action_mask"])

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, torch.Tensor]:
        """Return masked logits under the key that RLlib reads."""
        return {Columns.ACTION_DIST_INPUTS: self._outputs(batch)[0]}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> torch.Tensor:
        """Return the values of states, [B]."""
        return self._outputs(batch)[1]
