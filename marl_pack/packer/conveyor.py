"""Read boxes: a file of orders, or a conveyor of JSON lines, one line a box."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from marl_pack.checks import one_line
from marl_pack.exact.goods import GOODS_ATTRIBUTES, Goods
from marl_pack.exact.lengths import to_mm
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import SIDES, Order, check_record
from marl_pack.inputs import unique_keys
from marl_pack.packer.calls import BOX_ATTRIBUTES, goods_of

LONGEST_LINE = 1 << 16
"""Largest number of characters in a line of a conveyor."""


@dataclass(frozen=True)
class Arrival:
    """A box as it comes.

    Attributes:
        sides: own sides w, d, h in millimetres.
        attributes: those of :meth:`marl_pack.packer.packer.Packer.place`.
        order: name of its order; "" for none.
    """

    sides: list[float]
    attributes: dict[str, Any]
    order: str = ""


@dataclass(frozen=True)
class Refused:
    """A line that is not a box, and why."""

    reason: str


def of_orders(orders: Iterable[Order]) -> Iterator[Arrival]:
    """Yield the boxes of orders, one after the other."""
    for order in orders:
        goods = order.goods
        for i in range(len(goods)):
            yield Arrival(
                to_mm(goods.sides[i], goods.unit_mm).tolist(), _attributes(goods[[i]]), order.name
            )


def _attributes(item: Goods) -> dict[str, Any]:
    """Return the attributes of one row of goods."""
    weight, load = float(item.weights[0]), float(item.max_load[0])
    return {
        "id": str(item.ids[0]) or None,
        "weight": None if weight != weight else weight,
        "orientations": [o for o in range(6) if item.orientations[0, o]],
        "stackable": bool(item.stackable[0]),
        "max_load": None if load == float("inf") else load,
    }


def of_line(text: str, number: int, spec: ExactSpec) -> Arrival | Refused | None:
    """Return the box in a line of a conveyor; None for an empty line.

    A line is a JSON object with the keys of a file of goods
    (:data:`marl_pack.exact.streams.COLUMNS`), but for ``quantity``.

    Args:
        text: the line.
        number: its number, for messages.
        spec: the options of the bin.
    """
    if not text.strip():
        return None
    source = f"line {number}"
    try:
        if len(text) > LONGEST_LINE:
            raise ValueError(f"{source}: needs at most {LONGEST_LINE} characters")
        try:
            content = json.loads(text, parse_constant=_no_constant, object_pairs_hook=unique_keys)
        except (ValueError, KeyError, RecursionError) as error:
            raise ValueError(f"{source}: not readable as JSON ({one_line(str(error))})") from None
        record = check_record(content, source, leave_out=("quantity",))
        if {"order", "sequence"} <= set(record):
            raise ValueError(f"{source}: has order and sequence, which mean the same")
        keys = {attribute.key: attribute.column for attribute in GOODS_ATTRIBUTES}
        attributes = {
            name: record[keys[key]]
            for name, key in BOX_ATTRIBUTES.items()
            if record.get(keys[key]) is not None
        }
        order = record.get("order", record.get("sequence"))
        sides = [record[side] for side in SIDES]
        try:
            goods_of(sides, attributes, spec)
        except ValueError as error:
            reason = str(error).replace("box: row 0", "the box")
            raise ValueError(f"{source}: {reason}") from None
        return Arrival(sides, attributes, "" if order is None else str(order))
    except ValueError as error:
        return Refused(str(error))


def _no_constant(name: str) -> Any:
    """Refuse NaN and Infinity, which are not JSON."""
    raise ValueError(f"{name} is not a number")
