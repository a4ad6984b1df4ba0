"""Pack boxes one by one, in millimetres: :class:`Packer`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from marl_pack.checks import LARGEST_SEED, shown, truth_value, whole_number
from marl_pack.exact.bins import ExactBins
from marl_pack.exact.explaining import explain
from marl_pack.exact.goods import Goods, fitting
from marl_pack.exact.lengths import to_mm
from marl_pack.exact.present import check_present
from marl_pack.exact.spec import ExactSpec
from marl_pack.explanation import Explanation
from marl_pack.option_record import document
from marl_pack.packer import calls
from marl_pack.packer.answers import NoPlace, Placement, Waiting
from marl_pack.packer.calls import (
    Call,
    Opened,
    Placed,
    PlacedNext,
    Reported,
    Shown,
    Skipped,
    SkippedNext,
)
from marl_pack.packer.choosing import (
    Known,
    able_or_refused,
    check_order,
    decide,
    refused_by_empty_bin,
)
from marl_pack.packer.journal import Journal
from marl_pack.packer.open_bins import OpenBins, row_of
from marl_pack.packer.packed import Packed
from marl_pack.packer.policies import PackerPolicy, make_packer_policy
from marl_pack.packer.poses import Pose
from marl_pack.packer.reasons import why_not
from marl_pack.packer.report import PackerState, plan_of, state_of
from marl_pack.plan import LeftOut, Plan

MOST_BINS = 1_000_000
MOST_VISIBLE, MOST_OPEN = 64, 16
"""Most boxes in a buffer and in a preview, and open bins."""


@dataclass(frozen=True)
class _Offer:
    """What would be done with a box."""

    known: Known
    answer: Placement | NoPlace
    move: int = -1
    explanation: Explanation | None = None
    given: Goods | None = None  # as ``place`` got it; None: a box that was shown


@document(ExactSpec, " " * 8)
class Packer(Journal):
    """Pack boxes as they come: boxes in, poses out, in millimetres.

    A box gets the place that the policy chooses among those that the rule allows. By default one
    bin is open, and :meth:`place` gives each box its place. With a buffer or a preview,
    :meth:`show` tells of the boxes that come, and :meth:`place_next` places one of them.

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
        open_next: whether the fullest open bin is closed and the next one is opened when no visible
            box has a place in an open bin.
        buffer: number of visible boxes k, any of which may be placed next.
        preview: number of boxes p after the visible ones that are known, but not placed yet.
        open_bins: number of bins b that are open at once.
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
        buffer: int = 1,
        preview: int = 0,
        open_bins: int = 1,
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
        self.buffer = whole_number(buffer, "buffer", 1, MOST_VISIBLE)
        self.preview = whole_number(preview, "preview", 0, MOST_VISIBLE)
        self.open_bins = whole_number(open_bins, "open_bins", 1, MOST_OPEN)
        if self.most_bins is not None and self.open_bins > self.most_bins:
            raise ValueError(
                f"open_bins = {self.open_bins}: needs at least as many bins, not bins = "
                f"{self.most_bins} (None allows any number)"
            )
        seed = whole_number(seed, "seed", 0, LARGEST_SEED)
        self.arguments = {
            "policy": policy, "bins": self.most_bins, "open_next": open_next,
            "buffer": self.buffer, "preview": self.preview, "open_bins": self.open_bins,
            "plan": plan, "catalogue": catalogue, "grid_mm": grid_mm, "seed": seed,
            "explain": truth_value(explain, "explain"),
        }  # fmt: skip
        self.present = check_present(present, self.spec)
        self.policy: PackerPolicy = make_packer_policy(
            policy, self.spec, plan=plan, catalogue=catalogue, grid_mm=grid_mm, seed=seed
        )
        self.calls: list[Call] = []
        self._begin()

    def _begin(self) -> None:
        """Open the first bins; boxes that are there already are in the first one."""
        self._bins = OpenBins(self.spec, self.open_bins, self.most_bins, self.present)
        self.left_out: list[LeftOut] = []
        self._shown: list[Goods] = []  # all boxes, by their numbers
        self._known: list[Known] = []  # those that are not placed yet, in the order of the conveyor
        self._offered: _Offer | None = None

    @property
    def bin(self) -> ExactBins:
        """The open bin that was opened last."""
        return self._bins.last

    @property
    def orders(self) -> list[str]:
        """The order that each bin belongs to; "" for none."""
        return self._bins.orders

    @property
    def packed(self) -> list[list[Packed]]:
        """The boxes in each bin."""
        return [self._bins.in_bin(k) for k in range(len(self._bins))]

    # --- boxes ------------------------------------------------------------------------------------

    def offer(
        self, sides: Sequence[float], *, order: str = "", **attributes: Any
    ) -> Placement | NoPlace:
        """Return what :meth:`place` would do; nothing changes.

        Args:
            sides: the box's own sides w, d, h in millimetres.
            order, attributes: as for :meth:`place`.
        """
        return self._offer("offer", sides, order, attributes).answer

    def place(
        self, sides: Sequence[float], *, order: str = "", **attributes: Any
    ) -> Placement | NoPlace:
        """Place a box.

        Args:
            sides: the box's own sides w, d, h in millimetres.
            order: name of its order. A box gets no place beside boxes of another order.
            **attributes: ``id`` (a text or a number), ``weight`` (kilograms), ``upright`` (whether
                it may not be tipped), ``orientations`` (a list of 0 … 5), ``stackable`` (whether
                anything may rest on it) and ``max_load`` (kilograms of all boxes above it).

        Returns:
            The placement; or :class:`marl_pack.packer.answers.NoPlace` with the reason, and then
            nothing has changed.

        Raises:
            ValueError: if a side or an attribute is impossible, or there is a buffer or a preview;
                says what would be right.
        """
        offer = self._offer("place", sides, order, attributes)
        if isinstance(offer.answer, Placement):
            item = offer.known.item
            self._do(Placed(item, offer.answer.bin, offer.move, order, offer.explanation))
        return offer.answer

    @property
    def needs_box(self) -> bool:
        """Whether more boxes should be shown before the next decision: fewer than k + p are known.

        Where the conveyor brings no more boxes, :meth:`place_next` places the rest without them.
        """
        return len(self._known) < self.buffer + self.preview

    @property
    def waiting(self) -> tuple[Waiting, ...]:
        """The boxes that were shown and are not placed yet: the k visible ones, then the others."""
        return tuple(known.waiting(self.spec.unit_mm) for known in self._known)

    def show(
        self, sides: Sequence[float], *, order: str = "", **attributes: Any
    ) -> Waiting | NoPlace:
        """Tell of the next box of the conveyor.

        Args:
            sides, order, attributes: the box, as for :meth:`place`.

        Returns:
            The box with its number, the count of boxes that came before it; or
            :class:`marl_pack.packer.answers.NoPlace` if it has no place in an empty bin, and then
            nothing has changed: :meth:`skip` records it.

        Raises:
            ValueError: if k + p boxes are known, or the box is impossible.
        """
        if not self.needs_box:
            raise ValueError(
                f"show: {len(self._known)} boxes are known, as many as may be (buffer + preview); "
                "place_next places one"
            )
        item, order = calls.goods_of(sides, attributes, self.spec), check_order(order)
        able, refusal = refused_by_empty_bin(item, self.spec)
        if refusal is not None:
            return refusal
        self._do(Shown(able, order))
        return self.waiting[-1]

    def offer_next(self) -> Placement | NoPlace:
        """Return what :meth:`place_next` would do; nothing changes.

        Raises:
            ValueError: if no box is known.
        """
        return self._offer_next("offer_next").answer

    def place_next(self) -> Placement | NoPlace:
        """Choose one of the visible boxes and place it; the next known box becomes visible.

        Where none has a place in an open bin, the fullest open bin is closed and replaced by a new
        one, as far as ``bins`` and ``open_next`` allow it.

        Returns:
            The placement, whose ``number`` says which box it is; or
            :class:`marl_pack.packer.answers.NoPlace` if no visible box has a place, with the reason
            for the one that was shown first. Then nothing has changed: :meth:`skip_next` leaves it
            out.

        Raises:
            ValueError: if no box is known.
        """
        offer = self._offer_next("place_next")
        if isinstance(offer.answer, Placement):
            number = offer.known.number
            assert number is not None
            self._do(PlacedNext(number, offer.answer.bin, offer.move, offer.explanation))
        return offer.answer

    def skip_next(self) -> NoPlace:
        """Leave out the visible box that was shown first, and record why; the plan lists it.

        Raises:
            ValueError: if a visible box has a place, or no box is known.
        """
        offer = self._offer_next("skip_next")
        if isinstance(offer.answer, Placement):
            raise ValueError("skip_next: a visible box has a place; place_next places it")
        number = offer.known.number
        assert number is not None
        self._do(SkippedNext(number, offer.answer.code, offer.answer.reason))
        return offer.answer

    def skip(self, sides: Sequence[float], *, order: str = "", **attributes: Any) -> NoPlace:
        """Leave out a box that has no place, and record why; the plan lists it.

        With a buffer or a preview this is for boxes that :meth:`show` refuses.

        Args:
            sides, order, attributes: the box, as for :meth:`place`.

        Raises:
            ValueError: if the box has a place, or is impossible.
        """
        if self._selects:
            item = calls.goods_of(sides, attributes, self.spec)
            check_order(order)
            able, answer = refused_by_empty_bin(item, self.spec)
            if answer is None:
                raise ValueError("skip: the box has a place in an empty bin; show it")
        else:
            offer = self._offer("skip", sides, order, attributes)
            if isinstance(offer.answer, Placement):
                raise ValueError("skip: the box has a place; place it")
            able, answer = offer.known.item, offer.answer
        self._do(Skipped(able, answer.code, answer.reason))
        return answer

    def next_bin(self) -> int:
        """Close the fullest open bin and open the next one; return its number.

        Raises:
            ValueError: if the open bins are empty, or no more bins may be opened.
        """
        self._do(Opened())
        return len(self._bins) - 1

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
            ValueError: if no box was placed, its bin is closed, or it cannot be there: it would
                overlap another box or reach out of the bin.
        """
        self._do(Reported(Pose.of(pose)))
        return self._bins.boxes[-1].placement

    # --- what was done ----------------------------------------------------------------------------

    @property
    def placements(self) -> tuple[Placement, ...]:
        """The placements so far, in order; boxes that were there already come first."""
        return tuple(box.placement for box in self._bins.boxes)

    @property
    def state(self) -> PackerState:
        """What the packer has done so far."""
        return state_of(self._bins, self.left_out, self.waiting)

    @property
    def plan(self) -> Plan:
        """All boxes placed so far, in millimetres, and those that were left out."""
        return plan_of(self._bins, self.left_out, bool(self.arguments["explain"]))

    # --- calls ------------------------------------------------------------------------------------

    def _apply(self, call: Call) -> None:
        """Change the bins by a call.

        Raises:
            ValueError: if it is impossible.
        """
        if isinstance(call, Placed):
            if self._selects:
                raise ValueError("place: while boxes are shown, each box has to be shown first")
            item = self._fitting(call.item)
            self._bins.place(item, call.order, call.bin, call.move, None, call.explanation)
            self._shown.append(item)
        elif isinstance(call, Reported):
            self._bins.move_last(call.pose)
        elif isinstance(call, Skipped):
            self._leave_out(call.item, call.reason)
            self._shown.append(call.item)
        elif isinstance(call, Shown):
            if not self.needs_box:
                raise ValueError("show: more boxes are known than buffer + preview")
            self._known.append(Known(self._fitting(call.item), call.order, len(self._shown)))
            self._shown.append(call.item)
        elif isinstance(call, PlacedNext):
            box = self._visible(call.number)
            self._bins.place(
                box.item, box.order, call.bin, call.move, call.number, call.explanation
            )
            self._known.remove(box)
        elif isinstance(call, SkippedNext):
            box = self._visible(call.number)
            self._leave_out(box.item, call.reason)
            self._known.remove(box)
        else:
            self._bins.open_next()
        self._offered = None

    def _leave_out(self, item: Goods, reason: str) -> None:
        """Record a box without a place."""
        w, d, h = to_mm(item.sides[0], self.spec.unit_mm).tolist()
        self.left_out.append(LeftOut(str(item.ids[0]), (w, d, h), reason))

    def _visible(self, number: int) -> Known:
        """Return a visible box.

        Raises:
            ValueError: if no visible box has the number.
        """
        for known in self._known[: self.buffer]:
            if known.number == number:
                return known
        raise ValueError(f"box {number}: is not visible")

    # --- offers -----------------------------------------------------------------------------------

    @property
    def _selects(self) -> bool:
        """Whether boxes have to be shown before they are placed."""
        return self.buffer + self.preview > 1 or bool(self._known)

    def _fitting(self, item: Goods) -> Goods:
        """Return a box with the orientations in which it fits into an empty bin.

        Raises:
            ValueError: if there is none, or it is too thin.
        """
        return fitting(item, self.spec, to_mm(item.sides, self.spec.unit_mm), "box")

    def _offer(
        self, call: str, sides: Sequence[float], order: str, attributes: Mapping[str, Any]
    ) -> _Offer:
        """Return what :meth:`place` would do with a box."""
        if self._selects:
            raise ValueError(
                f"{call}: with a buffer or a preview, show(box) tells of a box, and place_next() "
                "chooses and places one"
            )
        item, last = calls.goods_of(sides, attributes, self.spec), self._offered
        if (
            last is not None
            and last.given is not None
            and last.known.order == order
            and last.given.same(item)
        ):
            return last
        able, refusal = able_or_refused(item, self.spec)
        known = Known(able, check_order(order))
        if refusal is None:
            self._offered = replace(self._choose([known]), given=item)
        else:
            self._offered = _Offer(known, refusal, given=item)
        return self._offered

    def _offer_next(self, call: str) -> _Offer:
        """Return what :meth:`place_next` would do."""
        if not self._known:
            raise ValueError(f"{call}: no box is known; show(box) tells of one")
        if self._offered is None:
            self._offered = self._choose(self._known)
        return self._offered

    def _choose(self, known: Sequence[Known]) -> _Offer:
        """Choose a visible box and a place in an open bin or, if there is none, in the next one."""
        bins, first = self._bins, known[0]
        tried = {k: bin for k, bin in bins.open.items() if bins.admits(k, first.order)}
        offer = self._decide(known, bins.open)
        if offer is None and bins.may_open() and (self.open_next or not tried):
            new = {len(bins): ExactBins(1, self.spec)}
            tried = tried or new
            offer = self._decide(known, new)
        if offer is not None:
            return offer
        if tried:
            answers = [why_not(bin, first.item) for bin in tried.values()]
            no = next((answer for answer in answers if answer.code == "policy"), answers[0])
        else:
            many = self.most_bins != 1
            bins_used = f"all {self.most_bins} bins are used" if many else "the only bin is used"
            reason = f"it begins an order, and {bins_used}"
            no = NoPlace(str(first.item.ids[0]), "other_order", reason)
        return _Offer(first, replace(no, number=first.number))

    def _decide(self, known: Sequence[Known], open: Mapping[int, ExactBins]) -> _Offer | None:
        """Let the policy choose a visible box and its place in one of these bins; None: nowhere."""
        numbers = {box.number for box in known}
        before = [item for n, item in enumerate(self._shown) if n not in numbers]
        made = decide(self.policy, known, self.buffer, self._bins, open, before)
        if made is None:
            return None
        box, explains = made.known, self.arguments["explain"]
        why = explain(self.policy, made.turn, made.option, made.move) if explains else None
        answer = self._bins.placement(
            made.bin, open[made.bin], box.item, row_of(box.item, made.move), made.move & 7,
            box.number,
        )  # fmt: skip
        return _Offer(box, answer, made.move, why)
