"""The masked categorical distribution over an agent's actions, as rsl_rl's distributions are."""

from __future__ import annotations

import torch
from rsl_rl.modules.distribution import Distribution
from torch import Tensor, nn

FORBIDDEN = -1e9
"""Logit of an illegal action. Finite, so that entropy and KL are; its probability is exactly 0."""

LARGEST = 1e8
"""Logits are kept within ± this, well above :data:`FORBIDDEN`."""


class MaskedCategorical(Distribution):
    """Categorical over K actions of which only the masked ones can be drawn.

    Whoever calls :meth:`update` or :meth:`deterministic_output` sets :attr:`mask` first; actions
    are float [B, 1] holding whole numbers, as rsl_rl stores them.

    Args:
        output_dim: not used: K is that of the logits, so that one network serves every bin size.
    """

    mask: Tensor | None = None  # bool [B, K], true where legal

    def __init__(self, output_dim: int = 1) -> None:
        super().__init__(output_dim)
        self._log_probs: Tensor | None = None

    @property
    def input_dim(self) -> int:
        """Rows of logits the head makes for each action: one."""
        return self.output_dim

    def masked(self, logits: Tensor) -> Tensor:
        """The logits [B, K] with illegal ones at :data:`FORBIDDEN`, float32."""
        logits = logits.float().clamp(-LARGEST, LARGEST)  # else a huge one could pass the mask
        return logits if self.mask is None else torch.where(self.mask, logits, FORBIDDEN)

    def update(self, mlp_output: Tensor) -> None:
        """Take the logits [B, K] of the current states."""
        self._log_probs = self.masked(mlp_output).log_softmax(-1)

    def sample(self) -> Tensor:
        """One action a row, float [B, 1]."""
        # Inverse CDF: several times cheaper than torch.multinomial. The point is below the total
        # (rand() < 1, and so after rounding), and the first entry above it has a probability
        # greater than 0, so it is legal where sums are taken in order. A parallel sum may round
        # otherwise; then the best action stands in.
        probabilities = self.log_probs.exp()
        total = probabilities.cumsum(-1)
        point = torch.rand_like(total[:, :1]) * total[:, -1:]
        drawn = torch.searchsorted(total, point, right=True).clamp(max=total.shape[-1] - 1)
        possible = probabilities.gather(-1, drawn) > 0
        best = probabilities.argmax(-1, keepdim=True)
        return torch.where(possible, drawn, best).to(total.dtype)

    def deterministic_output(self, mlp_output: Tensor) -> Tensor:
        """The most probable action a row (the first of equals), float [B, 1]."""
        return self.masked(mlp_output).argmax(-1, keepdim=True).float()

    def as_deterministic_output_module(self) -> nn.Module:
        """Refused: the mask is an input, which rsl_rl's exporters do not know.

        Raises:
            NotImplementedError: ``python -m marl_pack.export`` writes the agents with their masks.
        """
        raise NotImplementedError("use python -m marl_pack.export, which applies the mask inside")

    @property
    def log_probs(self) -> Tensor:
        """Log-probabilities [B, K] of the states of the last :meth:`update`."""
        if self._log_probs is None:
            raise RuntimeError("call update() first")
        return self._log_probs

    @property
    def mean(self) -> Tensor:
        """The most probable action, float [B, 1]."""
        return self.log_probs.argmax(-1, keepdim=True).float()

    @property
    def std(self) -> Tensor:
        """Standard deviation of the action as a one-hot vector: sqrt(1 - Σ p²), [B]."""
        return (1 - self.log_probs.exp().square().sum(-1)).clamp(min=0).sqrt()

    @property
    def entropy(self) -> Tensor:
        """-Σ p log p, in nats [B]."""
        log_p = self.log_probs
        return -(log_p.exp() * log_p).sum(-1)

    @property
    def params(self) -> tuple[Tensor, ...]:
        """The log-probabilities [B, K]: what :meth:`kl_divergence` compares."""
        return (self.log_probs,)

    def log_prob(self, outputs: Tensor) -> Tensor:
        """Log-probability [B] of actions [B, 1]."""
        return self.log_probs.gather(-1, outputs.long()).squeeze(-1)

    def kl_divergence(
        self, old_params: tuple[Tensor, ...], new_params: tuple[Tensor, ...]
    ) -> Tensor:
        """KL(old || new) = Σ p_old (log p_old - log p_new), in nats [B]."""
        old, new = old_params[0], new_params[0]
        return (old.exp() * (old - new)).sum(-1)
