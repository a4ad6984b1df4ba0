"""The masked categorical distribution over an agent's actions, for rsl_rl's models."""

from __future__ import annotations

import torch
from rsl_rl.modules.distribution import Distribution
from torch import Tensor, nn

FORBIDDEN = -1e9
"""Logit of an illegal action. It is finite, so entropy and KL are finite; its probability is 0."""

LARGEST = 1e8
"""Largest absolute value of logits, so that legal ones stay well above :data:`FORBIDDEN`."""


class NotFiniteError(ValueError):
    """A network returns NaN because its weights are too large."""


def check_outputs(outputs: Tensor) -> None:
    """Refuse outputs of a network that are not numbers.

    Raises:
        NotFiniteError: if an output is NaN.
    """
    if bool(outputs.isnan().any()):
        raise NotFiniteError("an agent's network returns NaN: its weights are too large")


class MaskedCategorical(Distribution):
    """A categorical distribution over K actions that draws only legal ones.

    Set :attr:`mask` before each call of :meth:`update` or :meth:`deterministic_output`. Actions are
    whole numbers as float [B, 1], as rsl_rl stores them.

    Args:
        output_dim: not used: K comes from the logits, as one network plays on every bin size.
    """

    mask: Tensor | None = None  # bool [B, K], true where legal

    def __init__(self, output_dim: int = 1) -> None:
        super().__init__(output_dim)
        self._log_probs: Tensor | None = None

    @property
    def input_dim(self) -> int:
        """Number of logits that the head returns for each action: one."""
        return self.output_dim

    def masked(self, logits: Tensor) -> Tensor:
        """Return the logits [B, K] with illegal ones at :data:`FORBIDDEN`, float32."""
        logits = logits.float().clamp(-LARGEST, LARGEST)  # else a huge logit could pass the mask
        return logits if self.mask is None else torch.where(self.mask, logits, FORBIDDEN)

    def update(self, mlp_output: Tensor) -> None:
        """Set the distribution from the logits [B, K] of the current states."""
        self._log_probs = self.masked(mlp_output).log_softmax(-1)

    def sample(self) -> Tensor:
        """Draw one action for each row, float [B, 1]."""
        # Inverse CDF: several times cheaper than torch.multinomial. The point is below the total
        # (rand() < 1, also after rounding). If sums are taken in order, the first entry above the
        # point has a probability greater than 0, so it is legal. A parallel sum may round
        # differently; then the most probable action is taken instead.
        probabilities = self.log_probs.exp()
        total = probabilities.cumsum(-1)
        point = torch.rand_like(total[:, :1]) * total[:, -1:]
        drawn = torch.searchsorted(total, point, right=True).clamp(max=total.shape[-1] - 1)
        possible = probabilities.gather(-1, drawn) > 0
        best = probabilities.argmax(-1, keepdim=True)
        return torch.where(possible, drawn, best).to(total.dtype)

    def deterministic_output(self, mlp_output: Tensor) -> Tensor:
        """Return the most probable action of each row (the first of equal ones), [B, 1].

        Raises:
            NotFiniteError: if a logit is NaN.
        """
        check_outputs(mlp_output)
        return self.masked(mlp_output).argmax(-1, keepdim=True).float()

    def as_deterministic_output_module(self) -> nn.Module:
        """Refuse to export: rsl_rl's exporters cannot handle the mask, which is an input.

        Raises:
            NotImplementedError: always; ``python -m marl_pack.export`` exports agents with masks.
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
        """Entropy -Σ p log p of each row, in nats [B]."""
        log_p = self.log_probs
        return -(log_p.exp() * log_p).sum(-1)

    @property
    def params(self) -> tuple[Tensor, ...]:
        """The log-probabilities [B, K] that :meth:`kl_divergence` compares."""
        return (self.log_probs,)

    def log_prob(self, outputs: Tensor) -> Tensor:
        """Return the log-probabilities [B] of actions [B, 1]."""
        return self.log_probs.gather(-1, outputs.long()).squeeze(-1)

    def kl_divergence(
        self, old_params: tuple[Tensor, ...], new_params: tuple[Tensor, ...]
    ) -> Tensor:
        """Compute KL(old || new) = Σ p_old (log p_old - log p_new), in nats [B]."""
        old, new = old_params[0], new_params[0]
        return (old.exp() * (old - new)).sum(-1)
