"""Adapt the actor-critic to skrl, as one model for policy and value."""

from __future__ import annotations

from typing import Any

from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
from skrl.utils.spaces.torch import unflatten_tensorized_space

from marl_pack.integrations.network import ActorCritic


class MaskedModel(CategoricalMixin, DeterministicMixin, Model):
    """An :class:`ActorCritic` with skrl's interface; it applies the masks, which skrl does not.

    Args:
        agent: name of the agent, ``"orientation_0"`` or ``"placement_0"``.
        spaces: ``observation_space``, ``state_space`` and ``action_space`` of the agent.
    """

    def __init__(self, agent: str, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        CategoricalMixin.__init__(self, role="policy")
        DeterministicMixin.__init__(self, role="value")
        self.network = ActorCritic(agent.partition("_")[0])

    def act(self, inputs: dict[str, Any], *, role: str = "") -> Any:
        """Call the method ``act`` of the mixin for this role."""
        mixin = CategoricalMixin if role == "policy" else DeterministicMixin
        return mixin.act(self, inputs, role=role)

    def compute(self, inputs: dict[str, Any], role: str = "") -> Any:
        """Return masked logits [B, n], or values [B, 1]."""
        observation = unflatten_tensorized_space(self.observation_space, inputs["observations"])
        logits, values = self.network(observation["observation"], observation["action_mask"])
        return (logits if role == "policy" else values[:, None]), {}
