"""Streams of goods: which boxes come in which episode, and in what order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import described, shown, whole_number
from marl_pack.exact.goods import (
    GOODS_ATTRIBUTES,
    Goods,
    Lines,
    check_goods,
    goods_of,
    joined,
    quantities,
)
from marl_pack.exact.spec import ORDERS, ExactSpec
from marl_pack.inputs import read_json
from marl_pack.items.names import check_names
from marl_pack.items.tables import read_sides, read_table, sequence_order

LONGEST = 1e9
"""No length in millimetres is longer."""
SIDES = ("w_mm", "d_mm", "h_mm")
COLUMNS = (*SIDES, *(attribute.column for attribute in GOODS_ATTRIBUTES), "order", "sequence")
"""Columns of a CSV file of goods, and keys of the records of a JSON file."""


class GoodsStream(Protocol):
    """The boxes of numbered episodes."""

    @property
    def goods(self) -> Goods:
        """All boxes that may come."""

    @property
    def episodes(self) -> int | None:
        """Number of different episodes; None for any number."""

    def sequence(self, episode: int) -> NDArray[np.int64]:
        """Return the rows of ``goods`` that come in an episode, in order, int64 [L]."""

    def seeded(self, seed: int) -> GoodsStream:
        """Return the stream with another seed; given sequences do not depend on it."""


@dataclass(frozen=True)
class Given:
    """Sequences of goods as the user gave them; after the last one the first one follows.

    Args:
        goods: the boxes of all sequences, one sequence after the other.
        counts: int64 [S], number of boxes in each sequence.
    """

    goods: Goods
    counts: NDArray[np.int64]

    @property
    def episodes(self) -> int | None:
        """Number of sequences."""
        return len(self.counts)

    @cached_property
    def _ends(self) -> NDArray[np.int64]:
        return self.counts.cumsum()

    def sequence(self, episode: int) -> NDArray[np.int64]:
        """Return the rows of one sequence."""
        k = episode % len(self.counts)
        return np.arange(self._ends[k] - self.counts[k], self._ends[k])

    def seeded(self, seed: int) -> Given:
        """Return this stream: nothing in it is random."""
        return self


@dataclass(frozen=True)
class Draws:
    """Boxes drawn at random, each time with the same probabilities.

    Args:
        goods: the boxes to draw from.
        length: boxes in an episode.
        seed: seed of the draws; with the episode's number it determines them.
        probabilities: float64 [R]; None for equal ones.
    """

    goods: Goods
    length: int
    seed: int = 0
    probabilities: NDArray[np.float64] | None = None

    @property
    def episodes(self) -> int | None:
        """None: any number of episodes."""
        return None

    def sequence(self, episode: int) -> NDArray[np.int64]:
        """Return the rows drawn for one episode."""
        generator = np.random.default_rng((self.seed, episode))
        return generator.choice(len(self.goods), self.length, p=self.probabilities)

    def seeded(self, seed: int) -> Draws:
        """Return the stream with another seed."""
        return replace(self, seed=seed)


def windows(goods: Goods, length: int) -> Given:
    """Return the disjoint windows of ``length`` boxes, in order; a shorter rest is left out.

    Raises:
        ValueError: if there are fewer boxes than ``length``.
    """
    count = len(goods) // length
    if not count:
        raise ValueError(f"{len(goods)} boxes: needs at least {length} for a sequence")
    return Given(goods[: count * length], np.full(count, length))


def read_goods(path: Path, spec: ExactSpec) -> tuple[Goods, NDArray[np.int64]]:
    """Read a file of goods (:func:`read_orders`).

    Returns:
        The goods, one sequence after the other, and the number of boxes in each sequence, int64.
    """
    orders = read_orders(path, spec)
    goods = joined([order.goods for order in orders], spec.unit_mm)
    return goods, np.array([len(order.goods) for order in orders])


@dataclass(frozen=True)
class Order:
    """The boxes of one order, or one sequence, in their order."""

    name: str  # "" where it has none
    goods: Goods


def read_orders(path: Path, spec: ExactSpec) -> list[Order]:
    """Read a file of goods.

    A CSV file has the columns :data:`COLUMNS`; only ``w_mm``, ``d_mm`` and ``h_mm`` are needed. A
    JSON file has a list of records with such keys. A value that is left out is the default. Rows
    with the same ``order``, or ``sequence``, belong together. A JSON file may also have orders in
    the format of BED-BPP (Kagerer et al. 2023); its boxes stay upright.

    Args:
        path: the file.
        spec: the game.

    Raises:
        ValueError: naming the row, the column and what would be right.
    """
    suffix = path.suffix.lower()
    numbers: list[int] = []
    if suffix == ".csv":
        columns: dict[str, Any] = dict(
            read_table(path, COLUMNS, SIDES, blanks=True, numbers=numbers)
        )
        sides = read_sides(path, columns, SIDES, "a length in mm")
        for attribute in GOODS_ATTRIBUTES:
            if attribute.column in columns:
                texts = columns[attribute.column]
                given = iter(attribute.of_cells([text for text in texts if text]))
                columns[attribute.column] = [next(given) if text else None for text in texts]
    elif suffix == ".json":
        content = read_json(path)
        columns = _of_bed_bpp(path, content) if isinstance(content, dict) else {}
        columns = columns or _records(path, content)
        sides = np.array([columns[name] for name in SIDES], object).T
        sides = _numbers(sides, path)
    else:
        raise ValueError(f"{path}: unknown ending {path.suffix!r}: needs one of .csv, .json")
    if {"order", "sequence"} <= set(columns):
        raise ValueError(f"{path}: has order and sequence, which mean the same; needs one of them")
    names = columns.get("order", columns.get("sequence", [""] * len(sides)))
    names = ["" if name is None else str(name) for name in names]
    values = {
        attribute.key: columns[attribute.column]
        for attribute in GOODS_ATTRIBUTES
        if attribute.column in columns and attribute.key != "quantity"
    }
    source = Lines.of(path, numbers) if numbers else str(path)
    goods = check_goods(sides, spec, values, source=source)
    repeats = quantities(columns.get("quantity"), sides, source)
    order, counts = sequence_order(names)
    ends = counts.cumsum()
    parts = [order[end - count : end] for end, count in zip(ends, counts, strict=True)]
    return [Order(names[part[0]], goods[part.repeat(repeats[part])]) for part in parts]


def _of_bed_bpp(path: Path, content: dict[str, Any]) -> dict[str, list[Any]]:
    """Return the columns of orders in BED-BPP's format; none if the content is of another kind."""
    if not content or not all(
        isinstance(order, dict) and isinstance(order.get("item_sequence"), dict)
        for order in content.values()
    ):
        return {}
    keys = ("length/mm", "width/mm", "height/mm", "weight/kg")
    columns: dict[str, list[Any]] = {
        name: [] for name in (*SIDES, "weight_kg", "id", "upright", "order")
    }
    for name, order in content.items():
        for number, item in order["item_sequence"].items():
            if not isinstance(item, dict) or not set(keys) <= set(item):
                raise ValueError(
                    f"{path}: order {name}, item {number}: needs the keys {', '.join(keys)}"
                )
            row = [*(item[key] for key in keys), str(item.get("id", "")) or None, True, name]
            for column, value in zip(columns.values(), row, strict=True):
                column.append(value)
    return columns


def _records(path: Path, content: Any) -> dict[str, list[Any]]:
    """Return the columns of a JSON file with a list of records; None where a value is left out."""
    if not isinstance(content, list) or not content:
        raise ValueError(f"{path}: needs a list of records with the keys {', '.join(SIDES)}")
    for i, record in enumerate(content):
        check_record(record, f"{path}: row {i}")
    used = [name for name in COLUMNS if any(name in record for record in content)]
    return {name: [record.get(name) for record in content] for name in used}


def check_record(record: Any, source: str, leave_out: Sequence[str] = ()) -> dict[str, Any]:
    """Return a record of a box in JSON; refuse other values and unknown keys.

    Args:
        record: a dict with the keys :data:`COLUMNS`.
        source: name of the record, for messages.
        leave_out: keys that it may not have.

    Raises:
        ValueError: saying what is needed.
    """
    if not isinstance(record, dict):
        raise ValueError(f"{source}: needs a record with the keys {', '.join(SIDES)}")
    names = tuple(name for name in COLUMNS if name not in leave_out)
    check_names(record, names, SIDES, source, "key")
    for key in ("sequence", "order"):
        value = record.get(key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, str | int)):
            raise ValueError(f"{source}: {key} needs a text or a whole number")
    return record


def _numbers(rows: NDArray[Any], path: Path) -> NDArray[np.float64]:
    """Return rows of three numbers as float64 [R, 3]; refuse anything else."""
    for i, row in enumerate(rows.tolist()):
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in row)
        if not numbers or max(map(abs, row)) > LONGEST:
            raise ValueError(f"{path}: row {i} is {shown(row)}: needs three lengths in mm")
    return rows.astype(np.float64)


def make_goods_stream(
    items: Any, spec: ExactSpec, *, order: str = "file", length: int | None = None, seed: int = 0
) -> GoodsStream:
    """Return a stream of goods.

    Args:
        items: a CSV or JSON file (:func:`read_goods`), rows of sides in millimetres, a mapping with
            ``items`` and attributes, goods or a stream.
        spec: the game.
        order: ``"file"``: the sequences as they are given; with ``length`` the disjoint windows of
            this many boxes of all sequences, one after the other. ``"draw"``: each box is drawn at
            random, all with equal probability, so a row with a quantity of 3 comes three times as
            often.
        length: number of boxes in an episode; needed with ``"draw"``.
        seed: seed of the draws.

    Raises:
        ValueError: for an impossible argument; says what would be right.
    """
    if all(hasattr(items, name) for name in ("goods", "episodes", "sequence", "seeded")):
        stream: GoodsStream = items
        if stream.goods.unit_mm != spec.unit_mm:
            raise ValueError(f"items: needs a stream of goods in units of {spec.unit_mm:g} mm")
        return stream
    if order not in ORDERS:
        raise ValueError(f"order {order!r}: needs one of {', '.join(ORDERS)}")
    if length is not None:
        length = whole_number(length, "length", 1, 10**6)
    if isinstance(items, str | Path):
        goods, counts = read_goods(Path(items), spec)
    elif not isinstance(items, Goods | Mapping | Sequence | np.ndarray):
        raise ValueError(
            f"items: {described(items)} is not a file, rows of sides in mm, a mapping, Goods or a "
            "stream"
        )
    else:
        goods = goods_of(items, spec)
        counts = np.array([len(goods)])
    if order == "draw":
        if length is None:
            raise ValueError("order 'draw': needs length, the number of boxes in an episode")
        return Draws(goods, length, seed)
    return Given(goods, counts) if length is None else windows(goods, length)
