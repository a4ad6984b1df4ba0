"""The masked categorical distribution, against numbers worked by hand."""

import math

import pytest
import torch

from marl_pack.agents.networks.distribution import MaskedCategorical


def distribution_of(logits: list[list[float]], mask: list[list[bool]]) -> MaskedCategorical:
    distribution = MaskedCategorical()
    distribution.mask = torch.tensor(mask)
    distribution.update(torch.tensor(logits))
    return distribution


def test_probabilities_are_those_of_the_legal_actions_alone() -> None:
    # e^0 : e^ln3 = 1 : 3; the illegal middle one has the largest logit
    d = distribution_of([[0.0, 50.0, math.log(3)]], [[True, False, True]])
    assert torch.allclose(d.log_probs.exp(), torch.tensor([[0.25, 0.0, 0.75]]))
    assert d.log_probs.exp()[0, 1] == 0
    chosen = torch.tensor([[2.0]])
    assert d.log_prob(chosen).item() == pytest.approx(math.log(0.75))
    assert d.mean.item() == 2


def test_entropy_and_kl_by_hand() -> None:
    d = distribution_of([[0.0, 7.0, math.log(3)]], [[True, False, True]])
    entropy = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    assert d.entropy.item() == pytest.approx(entropy, rel=1e-6)
    assert d.std.item() == pytest.approx(math.sqrt(1 - 0.25**2 - 0.75**2), rel=1e-6)
    old = d.params
    d.update(torch.tensor([[0.0, -3.0, 0.0]]))  # 1/2 : 1/2
    kl = 0.25 * math.log(0.25 / 0.5) + 0.75 * math.log(0.75 / 0.5)
    assert d.kl_divergence(old, d.params).item() == pytest.approx(kl, rel=1e-6)
    assert d.kl_divergence(old, old).item() == 0


def test_gradients_of_illegal_actions_are_zero_and_all_are_finite() -> None:
    d = MaskedCategorical()
    d.mask = torch.tensor([[True, False, True], [False, True, False]])
    logits = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], requires_grad=True)
    d.update(logits)
    (d.entropy.sum() + d.log_prob(torch.tensor([[0.0], [1.0]])).sum()).backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    assert logits.grad[0, 1] == 0
    assert (logits.grad[1] == 0).all(), "one legal action: nothing to learn"


def test_a_row_without_a_legal_action_stays_finite() -> None:
    d = distribution_of([[1.0, 2.0], [1.0, 2.0]], [[False, False], [True, False]])
    old = d.params
    assert torch.isfinite(d.entropy).all()
    assert torch.isfinite(d.log_prob(torch.tensor([[1.0], [0.0]]))).all()
    d.update(torch.tensor([[2.0, 1.0], [0.0, 0.0]]))
    assert torch.isfinite(d.kl_divergence(old, d.params)).all()
    assert ((d.sample() >= 0) & (d.sample() < 2)).all()


def test_a_million_draws_hold_no_illegal_action_and_have_the_right_frequencies() -> None:
    torch.manual_seed(0)
    rows = 200
    d = MaskedCategorical()
    d.mask = torch.rand(rows, 37) < 0.4
    d.mask[:, 5] = True
    d.update(torch.randn(rows, 37) * 4)
    counts = torch.zeros(rows, 37)
    for _ in range(5000):
        counts.scatter_add_(1, d.sample().long(), torch.ones(rows, 1))
    assert counts.sum() == 1_000_000
    assert (counts[~d.mask] == 0).all()
    p = d.log_probs.exp()
    spread = (5000 * p * (1 - p)).sqrt()
    assert ((counts - 5000 * p).abs() <= 6 * spread + 6).all()


@pytest.mark.parametrize("at_end", [False, True])
def test_an_illegal_last_or_first_action_is_never_drawn_at_the_limits(
    at_end: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = torch.tensor(1 - 2**-24) if at_end else torch.tensor(0.0)
    monkeypatch.setattr(torch, "rand_like", lambda like: point.expand_as(like))
    torch.manual_seed(1)
    d = MaskedCategorical()
    d.mask = torch.rand(2000, 50) < 0.3
    d.mask[:, 0] = d.mask[:, -1] = False
    d.mask[:, 20] = True
    d.update(torch.randn(2000, 50) * 8)
    drawn = d.sample().long()
    assert d.mask.gather(1, drawn).all()


def test_the_best_action_is_legal() -> None:
    d = MaskedCategorical()
    d.mask = torch.tensor([[False, True, True]])
    assert d.deterministic_output(torch.tensor([[9.0, -5.0, -4.0]])).item() == 2


def test_no_finite_logit_passes_the_mask() -> None:
    d = MaskedCategorical()
    d.mask = torch.tensor([[False, True]])
    logits = torch.tensor([[3e9, -7e9]])
    assert d.deterministic_output(logits).item() == 1
    d.update(logits)
    assert d.sample().item() == 1
