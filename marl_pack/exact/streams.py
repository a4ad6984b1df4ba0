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
from marl_pack.exact.goods import GOODS_ATTRIBUTES, Goods, check_goods, goods_of
from marl_pack.exact.spec import ORDERS, ExactSpec
from marl_pack.inputs import read_json
from marl_pack.items.names import check_names
from marl_pack.items.tables import read_sides, read_table, sequence_order

LONGEST = 1e9
"""No length in millimetres is longer."""
SIDES = ("w_mm", "d_mm", "h_mm")
COLUMNS = (*SIDES, *(attribute.column for attribute in GOODS_ATTRIBUTES), "sequence")
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
    """Read a CSV or JSON file of goods.

    A CSV file has the columns :data:`COLUMNS`; only ``w_mm``, ``d_mm`` and ``h_mm`` are needed. A
    JSON file has a list of records with such keys. A value that is left out is the default. Rows
    with the same ``sequence`` belong to one sequence.

    Args:
        path: the file.
        spec: the game.

    Returns:
        The goods, one sequence after the other, and the number of boxes in each sequence, int64.

    Raises:
        ValueError: naming the row, the column and what would be right.
    """
    suffix = path.suffix.lower()
    if suffix == ".csv":
        columns: dict[str, Any] = dict(read_table(path, COLUMNS, SIDES, blanks=True))
        sides = read_sides(path, columns, SIDES, "a length in mm")
        for attribute in GOODS_ATTRIBUTES:
            if attribute.column in columns:
                texts = columns[attribute.column]
                given = iter(attribute.of_cells([text for text in texts if text]))
                columns[attribute.column] = [next(given) if text else None for text in texts]
    elif suffix == ".json":
        columns = _records(path)
        sides = np.array([columns[name] for name in SIDES], object).T
        sides = _numbers(sides, path)
    else:
        raise ValueError(f"{path}: unknown ending {path.suffix!r}: needs one of .csv, .json")
    names = [str(name or "") for name in columns.get("sequence", [""] * len(sides))]
    order, counts = sequence_order(names)
    values = {
        attribute.key: [columns[attribute.column][i] for i in order.tolist()]
        for attribute in GOODS_ATTRIBUTES
        if attribute.column in columns
    }
    goods = check_goods(sides[order], spec, values, source=str(path))
    if "quantity" in values:
        quantity = np.array([1 if q is None else q for q in values["quantity"]], np.int64)
        counts = np.add.reduceat(quantity, counts.cumsum() - counts)
    return goods, counts


def _records(path: Path) -> dict[str, list[Any]]:
    """Return the columns of a JSON file with a list of records; None where a value is left out."""
    content = read_json(path)
    if not isinstance(content, list) or not content:
        raise ValueError(f"{path}: needs a list of records with the keys {', '.join(SIDES)}")
    for i, record in enumerate(content):
        if not isinstance(record, dict):
            raise ValueError(f"{path}: row {i}: needs a record with the keys {', '.join(SIDES)}")
        check_names(record, COLUMNS, SIDES, f"{path}: row {i}", "key")
        if not isinstance(record.get("sequence", ""), str | int):
            raise ValueError(f"{path}: row {i}: sequence needs a text or a whole number")
    used = [name for name in COLUMNS if any(name in record for record in content)]
    return {name: [record.get(name) for record in content] for name in used}


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
