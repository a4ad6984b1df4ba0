"""Goods: the boxes to be packed, in whole units, with what may be done to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_pack.checks import decimals, number_in, real_number, shown
from marl_pack.exact.lengths import to_mm, to_units
from marl_pack.exact.spec import ExactSpec
from marl_pack.geometry import ALL_ORIENTATIONS, ORIENTATIONS
from marl_pack.items.attributes import ATTRIBUTES, TRUTH, UPRIGHT, Attribute
from marl_pack.items.names import check_names

NUMBERS = {2: "two", 3: "three", 6: "six"}
MOST_ROWS = 10_000_000
"""The largest number of boxes that goods may have, quantities counted."""

AXES = np.array(ORIENTATIONS)


def _max_load(value: Any) -> float:
    return real_number(value, "max_load")


GOODS_ATTRIBUTES: tuple[Attribute, ...] = (
    *(replace(a, column="weight_kg") if a.key == "weights" else a for a in ATTRIBUTES),
    Attribute(
        "stackable", "stackable", "true or false (1 or 0, yes or no)", (), np.bool_, "b", str,
        lambda value: TRUTH[value.lower() if isinstance(value, str) else value],
        lambda values: np.ones(len(values), bool),
    ),
    Attribute(
        "max_load_kg", "max_load", "a number ≥ 0", (), np.float64, "iuf", number_in, _max_load,
        lambda values: np.array(np.isfinite(values) & (values >= 0), bool),
    ),
)  # fmt: skip
"""The attributes that users may give with goods."""
DEFAULTS: dict[str, Any] = {
    "weights": np.nan, "upright": False, "orientations": True, "ids": "", "quantity": 1,
    "stackable": True, "max_load": np.inf,
}  # fmt: skip
"""What a row has that gives no value of an attribute."""
KEYS = tuple(attribute.key for attribute in GOODS_ATTRIBUTES)


@dataclass(frozen=True)
class Goods:
    """Boxes with their attributes, one row for each box."""

    sides: NDArray[np.int64]  # [R, 3]            own sides w, d, h in units
    weights: NDArray[np.float64]  # [R]           kilograms; NaN: unknown
    orientations: NDArray[np.bool_]  # [R, 6]     orientations it may be placed in
    stackable: NDArray[np.bool_]  # [R]           whether anything may rest on it
    max_load: NDArray[np.float64]  # [R]          largest weight above it, kilograms
    ids: NDArray[np.object_]  # [R]               its id, a text; "" where there is none
    unit_mm: float  # millimetres of one unit

    def __len__(self) -> int:
        return len(self.sides)

    def __getitem__(self, index: Any) -> Self:
        """Return the chosen rows."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        unit = columns.pop("unit_mm")
        return type(self)(**{name: column[index] for name, column in columns.items()}, unit_mm=unit)

    def same(self, other: Goods) -> bool:
        """Return whether the rows are equal, attributes included."""
        return all(
            np.array_equal(
                getattr(self, f.name), getattr(other, f.name), equal_nan=f.name == "weights"
            )
            for f in fields(self)
        )

    @property
    def volumes(self) -> NDArray[np.float64]:
        """Volume of each box in cubic units, float64 [R]."""
        return self.sides.astype(np.float64).prod(-1)


class ThinError(ValueError):
    """A box is lower than the level tolerance."""


class Lines(str):
    """The name of a file whose rows have numbers of lines, for messages."""

    numbers: Sequence[int]

    @classmethod
    def of(cls, path: Any, numbers: Sequence[int]) -> Lines:
        """Return the name of a file; ``numbers[i]`` is the line of row i."""
        lines = cls(path)
        lines.numbers = numbers
        return lines


def joined(parts: Sequence[Goods], unit_mm: float) -> Goods:
    """Return the rows of several goods in one record; all have the same unit."""
    names = [f.name for f in fields(Goods) if f.name != "unit_mm"]
    shapes: dict[str, Any] = {
        "sides": np.empty((0, 3), np.int64), "orientations": np.empty((0, 6), np.bool_),
        "stackable": np.empty(0, np.bool_), "ids": np.empty(0, object),
    }  # fmt: skip
    columns = {
        name: np.concatenate([
            shapes.get(name, np.empty(0)), *(getattr(part, name) for part in parts)
        ])
        for name in names
    }  # fmt: skip
    return Goods(**columns, unit_mm=unit_mm)


def check_goods(
    sides_mm: ArrayLike,
    spec: ExactSpec,
    attributes: Mapping[str, Any] | None = None,
    *,
    source: str = "items",
    fit: bool = True,
) -> Goods:
    """Check goods and return them in units; a row with a quantity is repeated.

    Args:
        sides_mm: numbers [R, 3], own sides w, d, h in millimetres.
        spec: the game, with its unit.
        attributes: values of :data:`GOODS_ATTRIBUTES` by key, one for each row, None for the
            default: ``weights``
            (kilograms), ``upright``, ``orientations``, ``ids``, ``quantity``, ``stackable``,
            ``max_load`` (kilograms).
        source: name of the goods in messages.
        fit: whether each box has to fit into the bin.

    Raises:
        ValueError: naming the row, and what would be right.
    """
    attributes = attributes or {}
    check_names(attributes, KEYS, (), source, "attribute")
    rows = number_rows(sides_mm, 3, source, "w d h in mm")
    values = {
        attribute.key: _column(attribute, attributes[attribute.key], rows, source)
        for attribute in GOODS_ATTRIBUTES
        if attributes.get(attribute.key) is not None
    }
    units, inexact = to_units(rows, spec.unit_mm)
    _refuse(~np.isfinite(rows).all(1), rows, source, "needs finite numbers")
    _refuse((rows <= 0).any(1), rows, source, "zero or negative; needs sides > 0 mm")
    _refuse(
        inexact.any(1), rows, source,
        f"needs whole units of {spec.unit_mm:g} mm; choose a smaller unit (unit_mm, --unit-mm)",
    )  # fmt: skip
    count = len(rows)
    goods = Goods(
        sides=units,
        weights=values.get("weights", np.full(count, DEFAULTS["weights"])),
        orientations=_allowed(values.get("orientations"), values.get("upright"), rows, source),
        stackable=values.get("stackable", np.full(count, DEFAULTS["stackable"])),
        max_load=values.get("max_load", np.full(count, DEFAULTS["max_load"])),
        ids=np.array([str(name) for name in values.get("ids", [DEFAULTS["ids"]] * count)], object),
        unit_mm=spec.unit_mm,
    )
    if fit:
        goods = fitting(goods, spec, rows, source)
    if "quantity" not in values:
        return goods
    return goods[np.arange(count).repeat(quantities(values["quantity"], rows, source))]


def quantities(values: Any, rows: NDArray[Any], source: str) -> NDArray[np.int64]:
    """Return how many boxes each row stands for, int64 [R]; None: one each.

    Raises:
        ValueError: if a quantity is not a whole number, or there are too many boxes.
    """
    if values is None:
        return np.ones(len(rows), np.int64)
    (attribute,) = (a for a in GOODS_ATTRIBUTES if a.key == "quantity")
    quantity = _column(attribute, values, rows, source)
    if quantity.sum(dtype=np.float64) > MOST_ROWS:
        raise ValueError(f"{source}: {quantity.sum()} boxes: needs at most {MOST_ROWS}")
    return quantity


def number_rows(values: Any, width: int, source: str, what: str) -> NDArray[np.float64]:
    """Return rows of numbers, float64 [R, width]; an empty list has no rows.

    Raises:
        ValueError: for anything else, such as texts, truth values or rows of other lengths.
    """
    try:
        rows = np.asarray(values)
    except ValueError:  # rows of different lengths
        rows = np.empty(0, object)
    if (
        rows.size == 0
        and rows.ndim <= 2
        and rows.dtype.kind == "f"
        and isinstance(values, Sequence)
    ):
        return np.empty((0, width))
    if rows.dtype.kind not in "iuf" or rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{source}: needs rows of {NUMBERS[width]} numbers, {what}")
    return decimals(rows)


def fitting(goods: Goods, spec: ExactSpec, rows: NDArray[Any], source: str) -> Goods:
    """Return goods with the orientations that the game allows; refuse those that cannot be placed.

    Args:
        goods: the goods.
        spec: the game.
        rows: the sides that messages show, [R, 3].
        source: name of the goods in messages.
    """
    if not len(goods):
        raise ValueError(f"{source}: needs at least one row of three numbers, w d h in mm")
    allowed = goods.orientations & np.isin(ALL_ORIENTATIONS, spec.orientations)
    _refuse(~allowed.any(1), rows, source, f"may not take an orientation of {spec.orientations}")
    placed = goods.sides[:, AXES]  # [R, 6, 3]
    fits = allowed & (placed <= _room(spec)).all(2)
    _refuse(
        ~fits.any(1), rows, source,
        f"fits into the bin of {' x '.join(f'{side:g}' for side in spec.bin_mm)} mm in none of its "
        "orientations",
    )  # fmt: skip
    thin = (fits & (placed[:, :, 2] <= spec.limits().tolerance)).any(1)
    try:
        _refuse(
            thin & (spec.level_tolerance_mm > 0), rows, source,
            f"lower than level_tolerance_mm = {spec.level_tolerance_mm:g}; needs a smaller "
            "tolerance",
        )  # fmt: skip
    except ValueError as error:
        raise ThinError(str(error)) from None
    return replace(goods, orientations=allowed)


def _room(spec: ExactSpec) -> NDArray[np.int64]:
    """Return the longest sides of a box that fits into the bin, int64 [3]."""
    gap = 2 * spec.limits().clearance
    return np.array(spec.size, np.int64) - np.array((gap, gap, 0), np.int64)


def _column(
    attribute: Attribute, values: Any, rows: NDArray[Any], source: str
) -> NDArray[Any]:  # fmt: skip
    """Return the checked values of one attribute, [R, *shape]; None means the default."""
    count = len(rows)
    if not isinstance(values, np.ndarray):
        listed = isinstance(values, Sequence) and not isinstance(values, str)
        values = list(values) if listed else []
    if len(values) != count:
        raise ValueError(f"{source}: {attribute.key!r} needs one value for each of {count} rows")
    given = np.array([value is not None for value in values], np.bool_)
    chosen = values if given.all() else [value for value in values if value is not None]
    array, invalid = attribute.read(chosen)
    wrong = np.zeros(count, np.bool_)
    wrong[given] = invalid
    text = shown(values[int(wrong.argmax())])
    _refuse(wrong, rows, source, f"{attribute.column} {text}; needs {attribute.needs}")
    if given.all():
        return array
    full: NDArray[Any] = np.full(
        (count, *attribute.shape), DEFAULTS[attribute.key], attribute.dtype
    )
    full[given] = array
    return full


def _allowed(
    orientations: NDArray[np.bool_] | None,
    upright: NDArray[np.bool_] | None,
    rows: NDArray[Any],
    source: str,
) -> NDArray[np.bool_]:
    """Return the orientations that both attributes allow for each row, bool [R, 6]."""
    stays_upright = np.isin(ALL_ORIENTATIONS, UPRIGHT)
    allowed = np.ones((len(rows), len(ALL_ORIENTATIONS)), np.bool_)
    if orientations is not None:
        allowed = orientations.copy()
    if upright is not None:
        if orientations is not None:
            tips = upright & (orientations & ~stays_upright).any(1)
            _refuse(tips, rows, source, "upright, so its orientations may only be 0 and 1")
        allowed[upright] &= stays_upright
    return allowed


def _refuse(wrong: Any, rows: NDArray[Any], source: str, why: str) -> None:
    """Raise ValueError about the first row where ``wrong`` [R] is true, if there is one."""
    for i in np.flatnonzero(wrong)[:1].tolist():
        line = f" (line {source.numbers[i]})" if isinstance(source, Lines) else ""
        raise ValueError(f"{source}: row {i}{line} is {shown(rows[i].tolist())}: {why}")


def goods_of(items: Any, spec: ExactSpec, source: str = "items") -> Goods:
    """Return goods from rows of sides in millimetres, a mapping with attributes, or goods.

    Raises:
        ValueError: for impossible goods, or goods in another unit than that of the game.
    """
    if isinstance(items, Goods):
        if items.unit_mm != spec.unit_mm:
            raise ValueError(
                f"{source}: goods in units of {items.unit_mm:g} mm; needs the game's unit_mm, "
                f"{spec.unit_mm:g}"
            )
        return fitting(items, spec, to_mm(items.sides, spec.unit_mm), source)
    if isinstance(items, Mapping):
        check_names(items, ("items", *KEYS), ("items",), source, "key")
        rest = {key: value for key, value in items.items() if key != "items"}
        return check_goods(items["items"], spec, rest, source=source)
    return check_goods(items, spec, source=source)
