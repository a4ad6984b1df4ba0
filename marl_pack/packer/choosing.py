"""Choose among the visible boxes and the open bins: the decision of a packer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from marl_pack.checks import shown
from marl_pack.exact.bins import NOWHERE, ExactBins
from marl_pack.exact.choice import LINEAR
from marl_pack.exact.goods import Goods, ThinError, fitting, joined
from marl_pack.exact.lengths import to_mm
from marl_pack.exact.policies import HEURISTICS, Scored
from marl_pack.exact.spec import ExactSpec
from marl_pack.packer.answers import NoPlace, Waiting
from marl_pack.packer.open_bins import OpenBins, stacked
from marl_pack.packer.policies import PackerPolicy
from marl_pack.packer.reasons import EVERY, why_not
from marl_pack.packer.turn import Turn


@dataclass(frozen=True, eq=False)
class Known:
    """A box that is known and not placed yet."""

    item: Goods  # one row
    order: str  # name of its order; "" for none
    number: int | None = None  # the boxes that came before it; None if it was not shown

    def waiting(self, unit_mm: float) -> Waiting:
        """Return the box for users; it was shown."""
        assert self.number is not None
        w, d, h = to_mm(self.item.sides[0], unit_mm).tolist()
        return Waiting(self.number, str(self.item.ids[0]), (w, d, h), self.order)


@dataclass(frozen=True, eq=False)
class Decision:
    """A box and its place."""

    known: Known
    bin: int  # number of the bin
    move: int
    turn: Turn
    option: int  # number of the option in the turn


def decide(
    policy: PackerPolicy,
    known: Sequence[Known],
    buffer: int,
    bins: OpenBins,
    open: Mapping[int, ExactBins],
    before: Sequence[Goods],
) -> Decision | None:
    """Let a policy choose a visible box and its place; None if it chooses none, or none has any.

    A bin that is not begun may only be begun by the order of the box that was shown first. What is
    known of orders that have no open bin is left out, and so is everything that is not known.

    Args:
        policy: the policy.
        known: the known boxes in the order in which they were shown.
        buffer: number of visible boxes.
        bins: the bins.
        open: those to choose from, by their numbers; one may be the next bin.
        before: the boxes that were shown before and are gone.

    Raises:
        ValueError: if the policy chooses a move that is not legal.
    """
    numbers, first = list(open), known[0].order
    begun = [k for k in numbers if k < len(bins) and bins.begun(k)]

    def admits(k: int, box: Known) -> bool:
        return bins.orders[k] == box.order if k in begun else box.order == first

    kept = [box for box in known if any(admits(k, box) for k in numbers)]
    barred = sum(box not in kept for box in known[:buffer])  # they stay in the buffer
    pairs = [
        (i, j)
        for i, box in enumerate(kept[: buffer - barred])
        for j, k in enumerate(numbers)
        if admits(k, box) and open[k].state.count[0] < bins.spec.max_boxes
    ]
    if not pairs:
        return None
    items = [box.item for box in kept]
    goods = items[0] if len(items) == 1 else joined(items, bins.spec.unit_mm)
    turn = Turn(stacked(list(open.values())), goods, buffer - barred, np.array(pairs), before)
    option, move = choose(policy, turn)
    if move < 0:
        return None
    i, j = pairs[option]
    return Decision(kept[i], numbers[j], move, turn, option)


def choose(policy: Any, turn: Turn) -> tuple[int, int]:
    """Return the option that a policy chooses, and its move; NOWHERE if it chooses none.

    The policy returns a move for each option, or NOWHERE. Of several options with a move, the best
    one is taken (:meth:`marl_pack.exact.options.Options.values`), by the weights of the policy or,
    if it has none, by those of ``max_contact``.

    Raises:
        ValueError: if it returns a move that is not legal.
    """
    moves, count = np.asarray(policy(turn), np.int64), len(turn.pairs)
    if moves.shape != (count,):
        raise ValueError(
            f"the policy returned moves of shape {[*moves.shape]}: needs one for each option, "
            f"[{count}]"
        )
    legal = turn.bins.legal(turn.items, moves)
    if not legal.all():
        raise ValueError(f"the policy chose a move that is not legal: {moves[int(legal.argmin())]}")
    wanted = np.flatnonzero(moves >= 0)
    if len(wanted) < 2:
        return (int(wanted[0]), int(moves[wanted[0]])) if len(wanted) else (0, NOWHERE)
    weights = HEURISTICS["max_contact"]().weights
    if isinstance(policy, Scored) and policy.kind == LINEAR:
        weights = policy.weights
    option = int(turn.values(weights, moves).argmax())
    return option, int(moves[option])


def able_or_refused(item: Goods, spec: ExactSpec) -> tuple[Goods, NoPlace | None]:
    """Return a box with the orientations in which it fits; or the box, and why it fits nowhere."""
    try:
        return fitting(item, spec, to_mm(item.sides, spec.unit_mm), "box"), None
    except ThinError:
        reason = f"it is lower than level_tolerance_mm = {spec.level_tolerance_mm:g}"
        return item, NoPlace(str(item.ids[0]), "too_thin", reason)
    except ValueError:
        size = " x ".join(f"{side:g}" for side in spec.bin_mm)
        reason = f"it fits into an empty bin of {size} mm in no orientation that it may take"
        return item, NoPlace(str(item.ids[0]), "too_large", reason)


def refused_by_empty_bin(item: Goods, spec: ExactSpec) -> tuple[Goods, NoPlace | None]:
    """Return as :func:`able_or_refused`; a box that is too heavy for a bin is refused, too."""
    able, refusal = able_or_refused(item, spec)
    empty = ExactBins(1, spec)
    if refusal is None and not empty.any_move(able, EVERY)[0]:
        refusal = why_not(empty, able)
    return able, refusal


def check_order(order: str) -> str:
    """Return the name of an order.

    Raises:
        ValueError: if it is not a text.
    """
    if not isinstance(order, str):
        raise ValueError(f"order {shown(order)}: needs a text")
    return order
