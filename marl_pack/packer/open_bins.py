"""The bins of a packer: which of them are open, and the boxes in all of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from marl_pack.exact.bins import ExactBins, placements
from marl_pack.exact.goods import AXES, Goods
from marl_pack.exact.lengths import to_mm
from marl_pack.exact.present import Present
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.state import State
from marl_pack.exact.support import Support, measure
from marl_pack.explanation import Explanation
from marl_pack.packer.answers import Placement
from marl_pack.packer.packed import Packed, row_at
from marl_pack.packer.poses import Pose

EVERY = np.ones(1, np.bool_)


class OpenBins:
    """Bins that are opened and closed one after the other, b of them at once.

    Attributes:
        open: the open bins by their numbers, one bin in each record.
        boxes: the boxes in all bins in the order in which they were placed; those that were there
            already come first.
        counts: number of boxes in each bin.
        orders: the order that each bin belongs to; "" for none.

    Args:
        spec: the options of a bin.
        count: number of open bins b.
        most: largest number of bins; None for any number.
        present: boxes that are in the first bin already.
    """

    def __init__(self, spec: ExactSpec, count: int, most: int | None, present: Present) -> None:
        self.spec, self.most, self.present = spec, most, present
        self.open: dict[int, ExactBins] = {}
        self.boxes: list[Packed] = []
        self.counts: list[int] = []
        self.orders: list[str] = []
        self._closed_weights: dict[int, float] = {}
        for _ in range(count):
            self._add_bin()
        for k in range(len(present.rows)):
            item, row = present.goods[[k]], _whole(present.rows[k])
            self._add(item, row, self.placement(0, self.open[0], item, row, -1))

    def __len__(self) -> int:
        """Return the number of bins opened so far."""
        return len(self.counts)

    @property
    def last(self) -> ExactBins:
        """The open bin that was opened last."""
        return self.open[max(self.open)]

    @property
    def volume(self) -> float:
        """Volume of a bin in cubic units."""
        return self.last.volume

    @property
    def weights(self) -> tuple[float, ...]:
        """Known weights in each bin, kilograms."""
        return tuple(
            float(self.open[k].weight[0]) if k in self.open else self._closed_weights[k]
            for k in range(len(self))
        )

    def in_bin(self, k: int) -> list[Packed]:
        """Return the boxes in bin ``k`` in the order in which they were placed."""
        return [box for box in self.boxes if box.placement.bin == k]

    # --- opening and closing ----------------------------------------------------------------------

    def begun(self, k: int) -> bool:
        """Return whether bin ``k`` has more boxes than those that were there already."""
        return self.counts[k] > (len(self.present.rows) if k == 0 else 0)

    def admits(self, k: int, order: str) -> bool:
        """Return whether a box of an order may be placed in bin ``k``: it is begun by no other."""
        return not self.begun(k) or self.orders[k] == order

    def may_open(self) -> bool:
        """Return whether another bin may replace an open one: none is empty, and one is left."""
        return all(self.counts[k] for k in self.open) and (
            self.most is None or len(self) < self.most
        )

    def check_next(self) -> None:
        """Refuse to open the next bin if the open ones are empty, or all bins are used.

        Raises:
            ValueError: saying which.
        """
        if not any(self.counts[k] for k in self.open):
            what = "bin is" if len(self.open) == 1 else "bins are"
            raise ValueError(f"next_bin: the open {what} empty")
        if self.most is not None and len(self) >= self.most:
            raise ValueError(
                f"next_bin: all {self.most} bins are open or closed (bins = {self.most}; None "
                "allows any number)"
            )

    def open_next(self) -> None:
        """Close the fullest open bin, the first of equal ones, and open the next one.

        Raises:
            ValueError: as :meth:`check_next`.
        """
        self.check_next()
        fullest = max(self.open, key=lambda k: float(self.open[k].utilization[0]))
        self._closed_weights[fullest] = float(self.open.pop(fullest).weight[0])
        self._add_bin()

    def _add_bin(self) -> None:
        self.open[len(self)] = ExactBins(1, self.spec)
        self.counts.append(0)
        self.orders.append("")

    # --- boxes ------------------------------------------------------------------------------------

    def place(
        self, item: Goods, order: str, k: int, move: int, number: int | None,
        explanation: Explanation | None,
    ) -> None:  # fmt: skip
        """Place a box in open bin ``k``, or in the next one if that is its number.

        Args:
            item: the box, one row.
            order: name of its order.
            k: number of the bin.
            move: where it is placed (:func:`marl_pack.exact.moves.encode`).
            number: number of the box, if it was shown.
            explanation: why.

        Raises:
            ValueError: if that is impossible; nothing has changed then.
        """
        wrong = ValueError(f"box {str(item.ids[0])!r}: its placement is not legal")
        opens = k == len(self)
        if opens:
            self.check_next()
        elif k not in self.open or not self.admits(k, order):
            raise wrong
        bin = ExactBins(1, self.spec) if opens else self.open[k]
        if not bin.legal(item, np.array([move]))[0]:
            raise wrong
        if opens:
            self.open_next()
        self.orders[k] = order
        row = row_of(item, move)
        answer = self.placement(k, bin, item, row, move & 7, number)
        self._add(item, row, answer, explanation=explanation)

    def move_last(self, pose: Pose) -> None:
        """Move the box that was placed last to the pose that a robot reported.

        Raises:
            ValueError: if no box was placed, its bin is closed, or it cannot be there.
        """
        placed = len(self.boxes) > len(self.present.rows)
        if not placed or self.boxes[-1].placement.bin not in self.open:
            raise ValueError("actual: no box was placed in the open bin")
        last = self.boxes[-1]
        planned, unit = last.planned, self.spec.unit_mm
        others = self.in_bin(planned.bin)[:-1]
        without = ExactBins(1, self.spec)
        row = row_at(pose, planned, others, without.size, unit)
        for box in others:
            without.add(box.row[None], box.item, EVERY)
        support = support_of(without, last.item, row)
        z = float(to_mm(row[2], unit))
        answer = Placement(
            planned.id, planned.bin, planned.orientation, pose.x - planned.w / 2,
            pose.y - planned.d / 2, z, planned.w, planned.d, planned.h,
            (pose.x, pose.y, z + planned.h / 2), support.share, _margin(support, unit), pose.yaw,
            "" if support.stands else f"it does not stand there by the rule {self.spec.rule}",
            planned.number,
        )  # fmt: skip
        self.open[planned.bin] = without
        self.boxes.pop()
        self.counts[planned.bin] -= 1
        self._add(last.item, row, answer, planned, last.explanation)

    def placement(
        self, k: int, bin: ExactBins, item: Goods, row: NDArray[np.int64], orientation: int,
        number: int | None = None,
    ) -> Placement:  # fmt: skip
        """Return the placement of a box at a row of ``bin``, which has the number ``k``."""
        support = support_of(bin, item, row)
        x, y, z, w, d, h = to_mm(row[:6], self.spec.unit_mm).tolist()
        return Placement(
            str(item.ids[0]), k, orientation, x, y, z, w, d, h, (x + w / 2, y + d / 2, z + h / 2),
            support.share, _margin(support, self.spec.unit_mm), number=number,
        )  # fmt: skip

    def _add(
        self, item: Goods, row: NDArray[np.int64], answer: Placement,
        planned: Placement | None = None, explanation: Explanation | None = None,
    ) -> None:  # fmt: skip
        """Add a box at a row to its bin."""
        self.open[answer.bin].add(row[None], item, EVERY)
        unit = self.spec.unit_mm
        middle = answer.centre[0] / unit, answer.centre[1] / unit
        self.boxes.append(Packed(item, answer, planned or answer, row, middle, explanation))
        self.counts[answer.bin] += 1


def stacked(bins: Sequence[ExactBins]) -> ExactBins:
    """Return bins of the same options in one record; a single record is returned as it is."""
    if len(bins) == 1:
        return bins[0]
    rows = max(bin.state.parts.shape[1] for bin in bins)
    states = []
    for bin in bins:
        more = rows - bin.state.parts.shape[1]
        parts = np.pad(bin.state.parts, ((0, 0), (0, more), (0, 0)))
        states.append(bin.state._replace(parts=parts))
    together = bins[0].select([0])
    together.state = State(*map(np.concatenate, zip(*states, strict=True)))
    return together


def support_of(bin: ExactBins, item: Goods, row: NDArray[np.int64]) -> Support:
    """Measure the support of a box at a row of the only bin."""
    weight = float(bin.weights_of(item)[0][0])
    return measure(bin, row, weight, bin.blocked(0, item))


def row_of(item: Goods, move: int) -> NDArray[np.int64]:
    """Return the row of the state of an item at a move, int64 [10]."""
    where = placements(move)
    return _whole(np.concatenate((where[1:], item.sides[0][AXES[where[0]]])))


def _whole(row: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the row of the state of a box whose whole top carries, int64 [10]."""
    return np.concatenate((row, row[:2], row[:2] + row[3:5]))


def _margin(support: Support, unit_mm: float) -> float | None:
    """Return a margin in millimetres; None if nothing carries."""
    return None if np.isnan(support.margin) else float(to_mm(support.margin, unit_mm))
