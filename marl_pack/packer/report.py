"""What a packer has done so far: its state and its plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marl_pack.exact.goods import joined
from marl_pack.packer.answers import Waiting
from marl_pack.packer.open_bins import OpenBins
from marl_pack.plan import LeftOut, Plan


@dataclass(frozen=True)
class PackerState:
    """What the packer has done so far."""

    bins: int  # number of bins opened, the open one included
    boxes: tuple[int, ...]  # number of boxes in each bin
    utilization: tuple[float, ...]  # share of each bin's volume that is filled
    weight: tuple[float, ...]  # known weights in each bin, kilograms
    left_out: tuple[LeftOut, ...]  # boxes that were skipped
    least_margin: float | None  # smallest margin of a box that rests on others, mm
    open_bins: tuple[int, ...]  # numbers of the open bins
    waiting: tuple[Waiting, ...]  # boxes that were shown and are not placed yet


def state_of(
    bins: OpenBins, left_out: Sequence[LeftOut], waiting: Sequence[Waiting]
) -> PackerState:
    """Return what a packer has done so far.

    Args:
        bins: its bins.
        left_out: the boxes that it left out.
        waiting: the boxes that were shown and are not placed yet.
    """
    filled = [0.0] * len(bins)
    for box in bins.boxes:
        filled[box.placement.bin] += float(box.item.volumes[0])
    placed = [box.placement for box in bins.boxes]
    margins = [p.margin for p in placed if p.z > 0 and p.margin is not None]
    return PackerState(
        len(bins), tuple(bins.counts), tuple(volume / bins.volume for volume in filled),
        bins.weights, tuple(left_out), min(margins, default=None), tuple(bins.open),
        tuple(waiting),
    )  # fmt: skip


def plan_of(bins: OpenBins, left_out: Sequence[LeftOut], explains: bool) -> Plan:
    """Return the boxes in all bins in order of placement, in millimetres.

    Args:
        bins: the bins.
        left_out: the boxes that were left out.
        explains: whether the plan has explanations.
    """
    boxes, spec = bins.boxes, bins.spec
    placed = [box.placement for box in boxes]
    items = joined([box.item for box in boxes], spec.unit_mm)
    weights, known = bins.last.weights_of(items)
    rows = np.array([(p.x, p.y, p.z, p.w, p.d, p.h) for p in placed]).reshape(-1, 6)
    whole = all(float(side).is_integer() for side in spec.bin_mm)
    if (rows == np.round(rows)).all() and whole:
        rows = rows.astype(np.int64)
    size = np.array(spec.bin_mm)
    return Plan(
        np.tile(size.astype(rows.dtype), (len(bins), 1)),
        np.array([p.bin for p in placed], np.int64), rows[:, :3], rows[:, 3:],
        np.array([p.orientation for p in placed], np.int64), weights,
        np.array([p.centre[:2] for p in placed]).reshape(-1, 2),
        tuple(p.id for p in placed), 1.0,
        yaws=np.array([p.yaw for p in placed]),
        weights_assumed=~known,
        stackable=items.stackable, max_loads=items.max_load,
        supports=np.array([p.support for p in placed]),
        margins=np.array([np.nan if p.margin is None else p.margin for p in placed]),
        left_out=tuple(left_out),
        orders=tuple(bins.orders) if any(bins.orders) else (),
        explanations=tuple(box.explanation for box in boxes if explains),
    )  # fmt: skip
