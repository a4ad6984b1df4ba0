"""Adapt the actor-critic to TorchRL, as modules that accept any leading dimensions."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_pack.integrations.network import ActorCritic


class Part(torch.nn.Module):
    """A module that returns one of a network's two outputs, for any leading dimensions.

    TorchRL adds a dimension of agents. In the other agent's turn, TorchRL's mask allows every
    action. Here an empty mask replaces it, so that logits are constant and no gradient reaches the
    policy from that turn. The critic learns the value of that turn.

    Args:
        network: the actor-critic.
        part: 0 for logits, 1 for values.
    """

    def __init__(self, network: ActorCritic, part: int) -> None:
        super().__init__()
        self.network, self.part = network, part

    def forward(self, planes: Tensor, mask: Tensor, acts: Tensor) -> Tensor:
        """Return masked logits [..., n], or values [..., 1].

        Args:
            planes: float [..., 4, W, D].
            mask: bool [..., n], where an action is legal.
            acts: bool [...], whether it is the agent's turn.
        """
        lead, legal = planes.shape[:-3], mask & acts[..., None]
        out = self.network(
            planes.reshape(-1, *planes.shape[-3:]), legal.reshape(-1, mask.shape[-1])
        )
        part: Tensor = out[self.part]
        return part.reshape(*lead, -1)
