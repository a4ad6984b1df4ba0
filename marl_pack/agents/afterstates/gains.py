"""What each placement gains in games with selection, by the critic of afterstates."""

from __future__ import annotations

from torch import Tensor

from marl_pack.agents.afterstates.limits import ILLEGAL
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.game.selection import SelectionPacking


def values_before(game: SelectionPacking, lookahead: Lookahead) -> Tensor:
    """Estimate the return that is still to come from the bin of each option, float32 [G, k · b]."""
    view = game.view()
    values = lookahead.memo.once(
        view,
        ("values_before", lookahead.critic),
        lambda: lookahead.state_value(game.bins, view)[game.bin_of],
    )
    return values.view(game.n, game.options)


def gains(game: SelectionPacking, lookahead: Lookahead) -> Tensor:
    """Compute what each placement gains, float32 [G, k · b, 6, W, D].

    The gain is the reward plus the value of the bin after the placement, minus its value before.

    Returns:
        The gains; :data:`ILLEGAL` where a placement is not legal.
    """
    view = game.view()
    before = values_before(game, lookahead).flatten()[:, None, None, None]
    values = (lookahead.afterstate_value(view) - before).where(view.mask, ILLEGAL)
    return values.view(game.n, game.options, *values.shape[1:])
