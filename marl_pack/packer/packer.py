"""Pack boxes one by one, in millimetres: :class:`Packer`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import LARGEST_SEED, shown, truth_value, whole_number
from marl_pack.exact.bins import ExactBins, placements
from marl_pack.exact.explaining import explain
from marl_pack.exact.goods import AXES, Goods, ThinError, fitting, joined
from marl_pack.exact.lengths import to_mm
from marl_pack.exact.present import Present, check_present
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.support import Support, measure
from marl_pack.explanation import Explanation
from marl_pack.files import write_json
from marl_pack.inputs import read_json
from marl_pack.option_record import document
from marl_pack.packer import calls
from marl_pack.packer.answers import NoPlace, Placement
from marl_pack.packer.calls import Call, Opened, Placed, Reported, Skipped
from marl_pack.packer.packed import Packed, row_at
from marl_pack.packer.policies import PackerPolicy, make_packer_policy
from marl_pack.packer.poses import Pose
from marl_pack.packer.reasons import why_not
from marl_pack.packer.turn import Turn
from marl_pack.plan import LeftOut, Plan

MOST_BINS = 1_000_000


@dataclass(frozen=True)
class _Offer:
    """What would be done with a box."""

    given: Goods  # one row
    order: str
    item: Goods  # the box with the orientations in which it fits
    answer: Placement | NoPlace
    move: int = -1
    explanation: Explanation | None = None


@dataclass(frozen=True)
class PackerState:
    """What the packer has done so far."""

    bins: int  # number of bins opened, the open one included
    boxes: tuple[int, ...]  # number of boxes in each bin
    utilization: tuple[float, ...]  # share of each bin's volume that is filled
    weight: tuple[float, ...]  # known weights in each bin, kilograms
    left_out: tuple[LeftOut, ...]  # boxes that were skipped
    least_margin: float | None  # smallest margin of a box that rests on others, mm


@document(ExactSpec, " " * 8)
class Packer:
    """Pack boxes as they come: boxes in, poses out, in millimetres.

    One bin is open. A box gets the place that the policy chooses among those that the rule allows.

    Attributes:
        spec: the options of the bins and of the rule.
        placements: the placements so far, in order.
        calls: the calls that changed it, in order (:mod:`marl_pack.packer.calls`).
        left_out: the boxes that were skipped, with the reasons.

    Args:
        bin_mm: inner sides W, D, H of a bin in millimetres; an option, as below.
        policy: a heuristic (``max_contact``, ``linear``, …), ``"search"``, a .json file of
            ``marl-pack tune``, a published model such as ``"rs"``, a run's folder or a checkpoint,
            or a function (:class:`marl_pack.exact.policies.ExactPolicy`).
        spec: the options; by default ``ExactSpec()``.
        bins: largest number of bins, one by default; None for any number.
        open_next: whether the next bin is opened when a box has no place in the open one.
        present: boxes that are in the first bin already
            (:func:`marl_pack.exact.present.check_present`).
        plan: settings of the policy ``search``, such as ``"budget=500ms"``.
        catalogue: goods from which the search draws the boxes to come, a file or as for
            :class:`marl_pack.exact.packing.ExactPacking`; by default what was shown so far.
        grid_mm: edge of the cells on which agents trained on cells see the bin.
        seed: seed of ``random`` and ``search``.
        explain: whether the plan says why each box is where it is
            (:class:`marl_pack.explanation.Explanation`).
        **options: options that replace those in ``spec``:
        {options}

    Raises:
        ValueError, FileNotFoundError: if an argument is impossible; says what would be right.
    """

    def __init__(
        self,
        bin_mm: Sequence[float] | None = None,
        policy: str | Path | Callable[[Any], Any] = "max_contact",
        *,
        spec: ExactSpec | None = None,
        bins: int | None = 1,
        open_next: bool = True,
        present: Any = (),
        plan: Any = None,
        catalogue: Any = None,
        grid_mm: float | None = None,
        seed: int = 0,
        explain: bool = False,
        **options: Any,
    ) -> None:
        if not (spec is None or isinstance(spec, ExactSpec)):
            raise ValueError(f"spec = {shown(spec)}: needs an ExactSpec")
        size = {} if bin_mm is None else {"bin_mm": bin_mm}
        self.spec = (spec or ExactSpec()).with_options({**options, **size})
        self.most_bins = None if bins is None else whole_number(bins, "bins", 1, MOST_BINS)
        self.open_next = truth_value(open_next, "open_next")
        seed = whole_number(seed, "seed", 0, LARGEST_SEED)
        self.arguments = {
            "policy": policy, "bins": self.most_bins, "open_next": open_next, "plan": plan,
            "catalogue": catalogue, "grid_mm": grid_mm, "seed": seed,
            "explain": truth_value(explain, "explain"),
        }  # fmt: skip
        self.present = check_present(present, self.spec)
        self.policy: PackerPolicy = make_packer_policy(
            policy, self.spec, plan=plan, catalogue=catalogue, grid_mm=grid_mm, seed=seed
        )
        self.calls: list[Call] = []
        self._begin()

    bin: ExactBins  # the open one

    def _begin(self) -> None:
        """Open the first bin, with the boxes that are there already."""
        self.packed: list[list[Packed]] = []
        self.orders: list[str] = []
        self.left_out: list[LeftOut] = []
        self._shown: list[Goods] = []
        self._offered: _Offer | None = None
        self._closed_weights: list[float] = []
        self._open_bin(self.present)

    def _open_bin(self, present: Present | None = None) -> None:
        """Open the next bin."""
        if self.packed:
            self._closed_weights.append(float(self.bin.weight[0]))
        self.bin = ExactBins(1, self.spec)
        self.packed.append([])
        self.orders.append("")
        if present is None:
            return
        for k in range(len(present.rows)):
            item, row = present.goods[[k]], _whole(present.rows[k])
            self._add(item, row, self._answer(item, row, -1, self._support(item, row)))

    # --- boxes ------------------------------------------------------------------------------------

    def offer(
        self, sides: Sequence[float], *, order: str = "", **attributes: Any
    ) -> Placement | NoPlace:
        """Return what :meth:`place` would do; nothing changes.

        Args:
            sides: the box's own sides w, d, h in millimetres.
            order, attributes: as for :meth:`place`.
        """
        return self._offer(self._goods(sides, attributes), order).answer

    def place(
        self, sides: Sequence[float], *, order: str = "", **attributes: Any
    ) -> Placement | NoPlace:
        """Place a box.

        Args:
            sides: the box's own sides w, d, h in millimetres.
            order: name of its order. A box of another order than the boxes in the open bin gets a
                place in the next bin only.
            **attributes: ``id`` (a text or a number), ``weight`` (kilograms), ``upright`` (whether
                it may not be tipped), ``orientations`` (a list of 0 … 5), ``stackable`` (whether
                anything may rest on it) and ``max_load`` (kilograms of all boxes above it).

        Returns:
            The placement; or :class:`marl_pack.packer.answers.NoPlace` with the reason, and then
            nothing has changed.

        Raises:
            ValueError: if a side or an attribute is impossible; says what would be right.
        """
        offer = self._offer(self._goods(sides, attributes), order)
        if isinstance(offer.answer, Placement):
            self._do(Placed(offer.item, offer.answer.bin, offer.move, order, offer.explanation))
        return offer.answer

    def skip(self, sides: Sequence[float], *, order: str = "", **attributes: Any) -> NoPlace:
        """Leave out a box that has no place, and record why; the plan lists it.

        Args:
            sides, order, attributes: the box, as for :meth:`place`.

        Raises:
            ValueError: if the box has a place, or is impossible.
        """
        offer = self._offer(self._goods(sides, attributes), order)
        if isinstance(offer.answer, Placement):
            raise ValueError("skip: the box has a place; place it")
        self._do(Skipped(offer.item, offer.answer.code, offer.answer.reason))
        return offer.answer

    def next_bin(self) -> int:
        """Close the open bin and open the next one; return its number.

        Raises:
            ValueError: if the open bin is empty, or no more bins may be opened.
        """
        self._do(Opened())
        return len(self.packed) - 1

    def actual(self, pose: Pose | Sequence[float]) -> Placement:
        """Report where the robot really put the box that was placed last.

        Later boxes keep away from the smallest rectangle around the rotated box, and rest only on a
        rectangle inside it. A pose that breaks the rule is accepted; ``problem`` says so.

        Args:
            pose: x, y of the box's middle in millimetres, and its yaw in degrees
                (:class:`marl_pack.packer.poses.Pose`).

        Returns:
            The placement as it is.

        Raises:
            ValueError: if no box was placed in the open bin, or one cannot be there: it would
                overlap another box or reach out of the bin.
        """
        self._do(Reported(Pose.of(pose)))
        return self.packed[-1][-1].placement

    def undo(self) -> None:
        """Undo the last call of ``place``, ``skip``, ``next_bin`` or ``actual``.

        Raises:
            ValueError: if there is none.
        """
        if not self.calls:
            raise ValueError("undo: nothing was done yet")
        self.replay(self.calls[:-1])

    def replay(self, done: Sequence[Call]) -> None:
        """Begin again and do calls, each of which is checked; if that fails, nothing changes.

        Args:
            done: calls that a packer with the same arguments recorded (:attr:`calls`).

        Raises:
            ValueError: if a call is impossible.
        """
        before = dict(vars(self))
        try:
            self._begin()
            for call in done:
                self._apply(call)
            self.calls = list(done)
        except ValueError:
            vars(self).update(before)
            raise

    # --- what was done ----------------------------------------------------------------------------

    @property
    def placements(self) -> tuple[Placement, ...]:
        """The placements so far, in order; boxes that were there already come first."""
        return tuple(packed.placement for bin in self.packed for packed in bin)

    @property
    def state(self) -> PackerState:
        """What the packer has done so far."""
        volume = self.bin.volume
        margins = [p.margin for p in self.placements if p.z > 0 and p.margin is not None]
        return PackerState(
            len(self.packed),
            tuple(len(bin) for bin in self.packed),
            tuple(
                float(sum(float(box.item.volumes[0]) for box in bin) / volume)
                for bin in self.packed
            ),
            (*self._closed_weights, float(self.bin.weight[0])),
            tuple(self.left_out),
            min(margins, default=None),
        )

    @property
    def plan(self) -> Plan:
        """All boxes placed so far, in millimetres, and those that were left out."""
        boxes = [packed for bin in self.packed for packed in bin]
        placed = [box.placement for box in boxes]
        items = joined([box.item for box in boxes], self.spec.unit_mm)
        weights, known = self.bin.weights_of(items)
        rows = np.array([(p.x, p.y, p.z, p.w, p.d, p.h) for p in placed]).reshape(-1, 6)
        if (rows == np.round(rows)).all() and _whole_numbers(self.spec.bin_mm):
            rows = rows.astype(np.int64)
        size = np.array(self.spec.bin_mm)
        return Plan(
            np.tile(size.astype(rows.dtype), (len(self.packed), 1)),
            np.array([p.bin for p in placed], np.int64), rows[:, :3], rows[:, 3:],
            np.array([p.orientation for p in placed], np.int64), weights,
            np.array([p.centre[:2] for p in placed]).reshape(-1, 2),
            tuple(p.id for p in placed), 1.0,
            yaws=np.array([p.yaw for p in placed]),
            weights_assumed=~known,
            stackable=items.stackable, max_loads=items.max_load,
            supports=np.array([p.support for p in placed]),
            margins=np.array([np.nan if p.margin is None else p.margin for p in placed]),
            left_out=tuple(self.left_out),
            orders=tuple(self.orders) if any(self.orders) else (),
            explanations=tuple(box.explanation for box in boxes if self.arguments["explain"]),
        )  # fmt: skip

    def save(self, path: str | Path) -> None:
        """Write everything that :meth:`restore` needs to a JSON file.

        A function as the policy, and a catalogue that is not a file, are not saved: they have to be
        given to :meth:`restore`.
        """
        content = calls.to_dict(self.spec, self.arguments, self.present, self.calls)
        write_json(Path(path), content)

    @classmethod
    def restore(cls, path: str | Path, **arguments: Any) -> Packer:
        """Return the packer that :meth:`save` wrote.

        The calls are done again and every placement is checked, so the file need not be trusted.

        Args:
            path: the file.
            **arguments: arguments of the packer that replace those in the file, such as ``policy``.

        Raises:
            ValueError: if the file is not such a file, or a call in it is impossible.
        """
        content = read_json(Path(path))
        try:
            made, rows = calls.read(content)
            packer = cls(**calls.complete(made, arguments))
            packer.replay([calls.of_row(row, packer.spec) for row in rows])
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        return packer

    # --- calls ------------------------------------------------------------------------------------

    def _do(self, call: Call) -> None:
        """Do a call and record it; if it is impossible, nothing changes."""
        self._apply(call)
        self._offered = None
        self.calls.append(call)

    def _apply(self, call: Call) -> None:
        """Change the bins by a call.

        Raises:
            ValueError: if it is impossible.
        """
        if isinstance(call, Placed):
            self._apply_placed(call)
        elif isinstance(call, Reported):
            self._apply_reported(call.pose)
        elif isinstance(call, Skipped):
            sides = to_mm(call.item.sides[0], self.spec.unit_mm).tolist()
            self._shown.append(call.item)
            name = str(call.item.ids[0])
            self.left_out.append(LeftOut(name, (sides[0], sides[1], sides[2]), call.reason))
        else:
            self._check_next()
            self._open_bin()

    def _apply_placed(self, call: Placed) -> None:
        """Place a box in the open bin, or in the next one."""
        opens = call.bin == len(self.packed)
        wrong = ValueError(f"box {str(call.item.ids[0])!r}: its placement is not legal")
        if opens:
            self._check_next()
        elif call.bin != len(self.packed) - 1 or not self._fits_order(call.order):
            raise wrong
        item = fitting(call.item, self.spec, to_mm(call.item.sides, self.spec.unit_mm), "box")
        bin = ExactBins(1, self.spec) if opens else self.bin
        if not bin.legal(item, np.array([call.move]))[0]:
            raise wrong
        if opens:
            self._open_bin()
        self.orders[-1] = call.order
        row = _row_of(item, call.move)
        answer = self._answer(item, row, call.move & 7, self._support(item, row))
        self._shown.append(item)
        self._add(item, row, answer, explanation=call.explanation)

    def _check_next(self) -> None:
        """Refuse to open the next bin if the open one is empty, or all bins are used.

        Raises:
            ValueError: saying which.
        """
        if not self.packed[-1]:
            raise ValueError("next_bin: the open bin is empty")
        if self.most_bins is not None and len(self.packed) >= self.most_bins:
            raise ValueError(
                f"next_bin: all {self.most_bins} bins are open or closed (bins = "
                f"{self.most_bins}; None allows any number)"
            )

    def _fits_order(self, order: str) -> bool:
        """Return whether a box of an order may be placed in the open bin."""
        begun = len(self.packed[-1]) > (len(self.present.rows) if len(self.packed) == 1 else 0)
        return not begun or self.orders[-1] == order

    def _add(
        self, item: Goods, row: NDArray[np.int64], answer: Placement,
        planned: Placement | None = None, explanation: Explanation | None = None,
    ) -> None:  # fmt: skip
        """Add a box at a row to the open bin."""
        self.bin.add(row[None], item, np.ones(1, np.bool_))
        unit = self.spec.unit_mm
        middle = answer.centre[0] / unit, answer.centre[1] / unit
        self.packed[-1].append(Packed(item, answer, planned or answer, row, middle, explanation))

    def _apply_reported(self, pose: Pose) -> None:
        """Move the last box of the open bin to the pose that a robot reported."""
        unit = self.spec.unit_mm
        if len(self.packed[-1]) <= (len(self.present.rows) if len(self.packed) == 1 else 0):
            raise ValueError("actual: no box was placed in the open bin")
        *others, last = self.packed[-1]
        planned = last.planned
        row = row_at(pose, planned, others, self.bin.size, unit)
        without = ExactBins(1, self.spec)
        for box in others:
            without.add(box.row[None], box.item, np.ones(1, np.bool_))
        weight = float(without.weights_of(last.item)[0][0])
        support = measure(without, row, weight, without.blocked(0, last.item))
        z = float(to_mm(row[2], unit))
        answer = Placement(
            planned.id, planned.bin, planned.orientation, pose.x - planned.w / 2,
            pose.y - planned.d / 2, z, planned.w, planned.d, planned.h,
            (pose.x, pose.y, z + planned.h / 2), support.share, _margin(support, unit), pose.yaw,
            "" if support.stands else f"it does not stand there by the rule {self.spec.rule}",
        )  # fmt: skip
        self.bin = without
        self.packed[-1] = others
        self._add(last.item, row, answer, planned, last.explanation)

    # --- offers -----------------------------------------------------------------------------------

    def _goods(self, sides: Sequence[float], attributes: Mapping[str, Any]) -> Goods:
        """Return a box as one row of goods; refuse impossible values."""
        return calls.goods_of(sides, attributes, self.spec)

    def _offer(self, item: Goods, order: str) -> _Offer:
        """Return what :meth:`place` would do with a box."""
        last = self._offered
        if last is not None and last.order == order and last.given.same(item):
            return last
        if not isinstance(order, str):
            raise ValueError(f"order {shown(order)}: needs a text")
        try:
            able = fitting(item, self.spec, to_mm(item.sides, self.spec.unit_mm), "box")
        except ThinError:
            reason = f"it is lower than level_tolerance_mm = {self.spec.level_tolerance_mm:g}"
            self._offered = _Offer(item, order, item, _no(item, "too_thin", reason))
        except ValueError:
            size = " x ".join(f"{side:g}" for side in self.spec.bin_mm)
            reason = f"it fits into an empty bin of {size} mm in no orientation that it may take"
            self._offered = _Offer(item, order, item, _no(item, "too_large", reason))
        else:
            self._offered = _Offer(item, order, able, *self._choose(able, order))
        return self._offered

    def _choose(
        self, item: Goods, order: str
    ) -> tuple[Placement | NoPlace, int, Explanation | None]:
        """Choose a place in the open bin or, if there is none, in the next one.

        Returns:
            The answer, the move (-1: no place) and, if it is asked for, the explanation.
        """
        more = self.most_bins is None or len(self.packed) < self.most_bins
        empty = not self.packed[-1]
        fits_order = self._fits_order(order)
        bins = {len(self.packed) - 1: self.bin} if fits_order else {}
        if not empty and more and (self.open_next or not fits_order):
            bins[len(self.packed)] = ExactBins(1, self.spec)
        for k, bin in bins.items():
            turn = Turn(bin, item, self._shown)
            move = int(self.policy(turn)[0]) if turn.alive[0] else -1
            if move < 0:
                continue
            if not bin.legal(item, np.array([move]))[0]:
                raise ValueError(f"the policy chose a move that is not legal: {move}")
            row = _row_of(item, move)
            support = measure(bin, row, float(bin.weights_of(item)[0][0]), bin.blocked(0, item))
            why = explain(self.policy, turn, 0, move) if self.arguments["explain"] else None
            return self._answer(item, row, move & 7, support, k), move, why
        if not bins:
            many = self.most_bins != 1
            bins_used = f"all {self.most_bins} bins are used" if many else "the only bin is used"
            return _no(item, "other_order", f"it begins an order, and {bins_used}"), -1, None
        return why_not(self.bin if fits_order else bins[len(self.packed)], item), -1, None

    def _support(self, item: Goods, row: NDArray[np.int64]) -> Support:
        """Measure the support of a box at a row of the open bin."""
        weight = float(self.bin.weights_of(item)[0][0])
        return measure(self.bin, row, weight, self.bin.blocked(0, item))

    def _answer(
        self, item: Goods, row: NDArray[np.int64], orientation: int, support: Support,
        bin: int | None = None,
    ) -> Placement:  # fmt: skip
        """Return the placement of a box at a row."""
        x, y, z, w, d, h = to_mm(row[:6], self.spec.unit_mm).tolist()
        return Placement(
            str(item.ids[0]), len(self.packed) - 1 if bin is None else bin, orientation, x, y, z, w,
            d, h, (x + w / 2, y + d / 2, z + h / 2), support.share,
            _margin(support, self.spec.unit_mm),
        )  # fmt: skip


def _no(item: Goods, code: str, reason: str) -> NoPlace:
    """Return that an item has no place."""
    return NoPlace(str(item.ids[0]), code, reason)


def _margin(support: Support, unit_mm: float) -> float | None:
    """Return a margin in millimetres; None if nothing carries."""
    return None if np.isnan(support.margin) else float(to_mm(support.margin, unit_mm))


def _whole(row: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the row of the state of a box whose whole top carries, int64 [10]."""
    return np.concatenate((row, row[:2], row[:2] + row[3:5]))


def _row_of(item: Goods, move: int) -> NDArray[np.int64]:
    """Return the row of the state of an item at a move, int64 [10]."""
    where = placements(move)
    return _whole(np.concatenate((where[1:], item.sides[0][AXES[where[0]]])))


def _whole_numbers(values: Sequence[float]) -> bool:
    return all(float(value).is_integer() for value in values)
