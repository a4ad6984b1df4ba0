"""Plans: boxes as they were placed, in order, in one bin or several.

A plan is the result of a game, or of any other program that places boxes. It is immutable. It can
be written to JSON and CSV files, which other programs can read, and be read from them. Archives of
many plans are in :mod:`marl_pack.plan_archive`. Shapes use the letters B (bins) and n (boxes).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_pack.checks import decimals, exact, number_in, real_number, whole_number
from marl_pack.explanation import Explanation
from marl_pack.files import write_csv, write_json
from marl_pack.geometry import ORIENTATIONS
from marl_pack.inputs import read_json, read_lines
from marl_pack.items.names import check_names
from marl_pack.plan_columns import ALL_COLUMNS, BOX, COLUMNS, EXTRAS, UNIT

if TYPE_CHECKING:
    from marl_pack.bins import Bins

Array = NDArray[Any]

SLACK = 1e-9
"""Share of a bin's longest side by which rounding may move a face or a centre outside."""

LONGEST = 1e9
"""The largest length in a plan: products and sums of lengths stay exact enough."""

VERSION = 2
"""Version of a plan in JSON. Version 1 had no ``version`` and only the keys :data:`BOX`."""
KEYS = (UNIT, "bins", "boxes")
"""Keys that every plan has in JSON."""
OPTIONAL = ("version", "orders", "left_out", "explanations")
"""Keys that a plan may have."""
LEFT_OUT = ("id", "w", "d", "h", "reason")
"""Keys of a box without a place."""


@dataclass(frozen=True)
class LeftOut:
    """A box that had no place."""

    id: str
    sides: tuple[float, float, float]  # own sides w, d, h in the plan's unit
    reason: str


@dataclass(frozen=True, eq=False)
class Plan:
    """The plan of n boxes in order of placement, in B bins.

    Lengths are in units of ``unit_mm`` millimetres. They are int64 if all lengths are whole
    numbers given as integers, else float64. Arrays are read-only copies of the arguments.

    Raises:
        ValueError: for an impossible shape or value, naming the field and the box.
    """

    bin_sizes: Array  # [B, 3]        sides W, D, H of each bin
    bins: NDArray[np.int64]  # [n]    bin of each box
    positions: Array  # [n, 3]        low corner x, y, z in its bin
    sides: Array  # [n, 3]            along x, y, z, as placed
    orientations: NDArray[np.int64]  # [n]   row of marl_pack.geometry.ORIENTATIONS; -1: unknown
    weights: NDArray[np.float64]  # [n]      > 0, in any unit (kilograms where it matters)
    centres: NDArray[np.float64]  # [n, 2]   x, y of the centre of mass in its bin
    ids: tuple[str, ...]  # [n]       "" where unknown
    unit_mm: float | None = None  # millimetres of one unit; None: abstract cells
    # Values of marl_pack.plan_columns.EXTRAS; None stands for the defaults.
    yaws: NDArray[np.float64] = None  # type: ignore[assignment]  # [n] degrees
    weights_assumed: NDArray[np.bool_] = None  # type: ignore[assignment]  # [n]
    stackable: NDArray[np.bool_] = None  # type: ignore[assignment]  # [n]
    max_loads: NDArray[np.float64] = None  # type: ignore[assignment]  # [n] inf: no limit
    supports: NDArray[np.float64] = None  # type: ignore[assignment]  # [n] NaN: unknown
    margins: NDArray[np.float64] = None  # type: ignore[assignment]  # [n] NaN: unknown
    left_out: tuple[LeftOut, ...] = ()  # boxes that had no place
    orders: tuple[str, ...] = ()  # [B]  order of each bin; () if there are no orders
    # [n]  why each box is where it is, None where unknown; () if there are none
    explanations: tuple[Explanation | None, ...] = ()

    def __post_init__(self) -> None:
        n, b = len(self.positions), len(self.bin_sizes)
        shapes = {
            "bin_sizes": (b, 3), "positions": (n, 3), "sides": (n, 3), "bins": (n,),
            "orientations": (n,), "weights": (n,), "centres": (n, 2),
        }  # fmt: skip
        arrays = {key: _numbers(key, getattr(self, key), shape) for key, shape in shapes.items()}
        lengths = ("bin_sizes", "positions", "sides")
        for key in lengths:
            if (arrays[key] > LONGEST).any():
                raise ValueError(f"{key}: needs lengths of at most {LONGEST:g}")
        whole = all(arrays[key].dtype.kind in "iu" or not arrays[key].size for key in lengths)
        kinds = dict.fromkeys(lengths, np.int64 if whole else np.float64)
        kinds |= {"bins": np.int64, "orientations": np.int64}
        for key, array in arrays.items():
            if kinds.get(key) is np.int64 and array.dtype.kind == "f" and array.size:
                raise ValueError(f"{key}: needs whole numbers")
            array = array.astype(np.int64) if kinds.get(key) is np.int64 else decimals(array)
            array.flags.writeable = False
            object.__setattr__(self, key, array)
        for extra in EXTRAS:
            values = extra.array(getattr(self, extra.field), n)
            values.flags.writeable = False
            object.__setattr__(self, extra.field, values)
        for key in ("ids", "left_out", "orders", "explanations"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        if len(self.explanations) not in (0, n):
            raise ValueError(f"explanations: needs one for each of {n} boxes, or none")
        if self.orders and (
            len(self.orders) != b or not all(isinstance(name, str) for name in self.orders)
        ):
            raise ValueError(f"orders: needs one text for each of {b} bins")
        if len(self.ids) != n or not all(isinstance(name, str) for name in self.ids):
            raise ValueError(f"ids: needs one text for each of {n} boxes")
        self._check_values()

    def _check_values(self) -> None:
        """Refuse impossible values, naming the first box that has one."""
        unit = self.unit_mm
        if unit is not None and real_number(unit, UNIT) <= 0:
            raise ValueError(f"unit_mm = {unit}: needs a positive length in millimetres")
        if not len(self.bin_sizes) or not (self.bin_sizes > 0).all():
            raise ValueError(f"bin_sizes {self.bin_sizes.tolist()}: needs positive sides W, D, H")
        last = len(self.bin_sizes) - 1
        self._refuse((self.bins < 0) | (self.bins > last), f"needs a bin from 0 to {last}")
        self._refuse((self.sides <= 0).any(1), "needs sides longer than 0")
        size = self.bin_sizes[self.bins]
        slack = SLACK * size.max(1, initial=0)[:, None]
        for extra in EXTRAS:
            valid = extra.check(getattr(self, extra.field))
            self._refuse(~valid, f"{extra.key}: needs {extra.needs}")
        high = self.positions + self.sides
        low_corners, high_corners = self.extents
        outside = (low_corners < -slack) | (high_corners > size + slack)
        self._refuse(outside.any(1), "reaches out of its bin")
        wrong = (self.orientations < -1) | (self.orientations >= len(ORIENTATIONS))
        self._refuse(wrong, f"needs an orientation from 0 to {len(ORIENTATIONS) - 1}, or -1")
        self._refuse(self.weights <= 0, "needs a positive weight")
        off = (self.centres < self.positions[:, :2] - slack) | (self.centres > high[:, :2] + slack)
        self._refuse(off.any(1), "needs a centre of mass inside the box")

    def _refuse(self, wrong: Any, why: str) -> None:
        """Raise ValueError about the first box for which ``wrong`` [n] is true, if there is one."""
        if wrong.any():
            i = int(wrong.argmax())
            row = ", ".join(f"{value:g}" for value in self.boxes[i])
            raise ValueError(f"box {i} ({row}): {why}")

    @classmethod
    def of_boxes(
        cls,
        bin_size: Sequence[float],
        boxes: ArrayLike,
        loads: ArrayLike | None = None,
        *,
        orientations: ArrayLike | None = None,
        ids: Sequence[str] | None = None,
        unit_mm: float | None = None,
    ) -> Plan:
        """Return the plan of boxes in one bin.

        Args:
            bin_size: the bin's W, D, H.
            boxes: [n, 6], rows x, y, z, w, d, h in order of placement.
            loads: [n, 3], weight and x, y of each centre of mass; by default the volume and the
                middle of the box.
            orientations: int [n]; unknown by default.
            ids: n texts; unknown by default.
            unit_mm: millimetres of one unit of length; None for abstract cells.

        Raises:
            ValueError: in the same cases as the constructor.
        """
        boxes = np.asarray(boxes)
        boxes = boxes if boxes.size else boxes.reshape(0, 6)
        if boxes.ndim != 2 or boxes.shape[1] != 6:
            raise ValueError(f"boxes: shape {boxes.shape}, needs [n, 6]: x, y, z, w, d, h")
        n, low, sides = len(boxes), boxes[:, :3], boxes[:, 3:]
        if loads is None:
            volumes = sides.astype(np.float64).prod(1)
            loads = np.column_stack((volumes, low[:, :2] + sides[:, :2] / 2))
        loads = np.asarray(loads).reshape(-1, 3)
        return cls(
            bin_sizes=np.asarray(bin_size)[None],
            bins=np.zeros(n, np.int64),
            positions=low,
            sides=sides,
            orientations=np.full(n, -1) if orientations is None else np.asarray(orientations),
            weights=loads[:, 0],
            centres=loads[:, 1:],
            ids=("",) * n if ids is None else tuple(ids),
            unit_mm=unit_mm,
        )

    @classmethod
    def from_bins(
        cls,
        bins: Bins,
        game: int,
        *,
        id_names: Sequence[str] | None = None,
        unit_mm: float | None = None,
    ) -> Plan:
        """Return the plan of one bin.

        Args:
            bins: the state of the bins, on the CPU.
            game: index of the bin.
            id_names: ``id_names[i]`` is the text of the id that the state stores as the number i;
                by default the text is the number itself.
            unit_mm: millimetres of a cell, if known.
        """
        n = int(bins.count[game])
        numbers = bins.labels[game, :n, 0].tolist()
        orientations = bins.labels[game, :n, 1].numpy()
        name: Callable[[int], str] = str if id_names is None else id_names.__getitem__
        return cls.of_boxes(
            bins.size, bins.boxes[game, :n].numpy(), bins.loads[game, :n].numpy(),
            orientations=orientations, unit_mm=unit_mm,
            ids=["" if number < 0 else name(number) for number in numbers],
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.positions)

    def __str__(self) -> str:
        boxes = f"{len(self)} box" + "es" * (len(self) != 1)
        unit = "cells" if self.unit_mm is None else f"units of {self.unit_mm:g} mm"
        if len(self.bin_sizes) == 1:
            sides = " × ".join(f"{side:g}" for side in self.bin_sizes[0].tolist())
            bins = f"a bin of {sides} {unit}"
        else:
            bins = f"{len(self.bin_sizes)} bins, in {unit}"
        return f"{boxes} in {bins}, {self.utilization:.1%} filled"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Plan):
            return NotImplemented
        plain = ("ids", "unit_mm", "left_out", "orders")
        if any(getattr(self, name) != getattr(other, name) for name in plain):
            return False
        if self._reasons() != other._reasons():
            return False
        arrays = [f.name for f in fields(Plan) if isinstance(getattr(self, f.name), np.ndarray)]
        return all(
            np.array_equal(mine, theirs, equal_nan=mine.dtype.kind == "f")
            for mine, theirs in ((getattr(self, name), getattr(other, name)) for name in arrays)
        )

    __hash__ = None  # type: ignore[assignment]  # arrays have no hash

    @property
    def boxes(self) -> Array:
        """Rows x, y, z, w, d, h of the boxes, [n, 6]."""
        return np.hstack((self.positions, self.sides))

    @property
    def extents(self) -> tuple[Array, Array]:
        """Low and high corners [n, 3] of the space that boxes take along the axes.

        They are those of the boxes themselves, but for boxes with a yaw.
        """
        low, high = self.positions, self.positions + self.sides
        if not self.yaws.any():
            return low, high
        cos, sin = np.cos(np.radians(self.yaws)), np.abs(np.sin(np.radians(self.yaws)))
        w, d = self.sides[:, 0], self.sides[:, 1]
        grown = np.column_stack((w * cos + d * sin, w * sin + d * cos)) - self.sides[:, :2]
        more = np.column_stack((grown / 2, np.zeros(len(self))))
        return low - more, high + more

    @property
    def has_extras(self) -> bool:
        """Whether a box has a value of :data:`EXTRAS` that is not the default."""
        return any(
            not extra.is_default(value)
            for extra in EXTRAS
            for value in getattr(self, extra.field).tolist()
        )

    @property
    def boxes_mm(self) -> NDArray[np.float64]:
        """Rows x, y, z, w, d, h of the boxes in millimetres, [n, 6].

        Raises:
            ValueError: if the plan is in abstract cells.
        """
        if self.unit_mm is None:
            raise ValueError("the plan is in abstract cells: its unit_mm is None")
        unit = exact(self.unit_mm)
        return np.asarray(self.boxes * float(unit.numerator) / unit.denominator)

    @property
    def loads(self) -> NDArray[np.float64]:
        """Weight and x, y of the centre of mass of the boxes, [n, 3]."""
        return np.column_stack((self.weights, self.centres))

    @property
    def utilization(self) -> float:
        """Share of the volume of all bins that is filled by boxes."""
        return float(_volume(self.sides) / _volume(self.bin_sizes))

    def first(self, count: int) -> Plan:
        """Return the plan of the first ``count`` boxes, in the same bins."""
        chosen = np.arange(len(self)) < count
        return self._select(chosen, self.bins, self.bin_sizes, self.orders)

    def in_bin(self, index: int) -> Plan:
        """Return the boxes of one bin as a plan of that bin alone."""
        sizes = self.bin_sizes[index : index + 1]
        orders = self.orders[index : index + 1]
        return self._select(self.bins == index, np.zeros_like(self.bins), sizes, orders)

    def _select(
        self, which: NDArray[np.bool_], bins: Array, bin_sizes: Array, orders: Sequence[str]
    ) -> Plan:
        """Return the plan of the boxes ``which`` [n]; ``bins`` [n] replaces the bin of each box."""
        return Plan(
            bin_sizes, bins[which], self.positions[which], self.sides[which],
            self.orientations[which], self.weights[which], self.centres[which],
            tuple(name for name, chosen in zip(self.ids, which, strict=True) if chosen),
            self.unit_mm, orders=tuple(orders),
            explanations=tuple(
                why for why, chosen in zip(self.explanations, which, strict=False) if chosen
            ),
            **{e.field: getattr(self, e.field)[which] for e in EXTRAS},
        )  # fmt: skip

    # --- files of one plan ------------------------------------------------------------------------

    def _rows(self) -> list[list[Any]]:
        """Return the values of :data:`BOX` for each box, as Python numbers and texts."""
        columns = (self.bins, self.positions, self.sides, self.orientations, self.weights,
                   self.centres)  # fmt: skip
        parts = [np.atleast_2d(array.T).T.tolist() for array in columns]
        return [[name, *chain(*row)] for name, *row in zip(self.ids, *parts, strict=True)]

    @classmethod
    def _of_rows(
        cls, bin_sizes: Any, rows: Sequence[Sequence[Any]], unit_mm: Any, **others: Any
    ) -> Plan:
        """Return the plan that has these rows (see :meth:`_rows`), and other fields."""
        table = dict(zip(BOX, zip(*rows, strict=True), strict=True)) if rows else {}

        def columns(*names: str) -> Array:
            return np.array([table.get(name, ()) for name in names]).T

        return cls(
            np.asarray(bin_sizes), columns("bin").ravel(), columns("x", "y", "z"),
            columns("w", "d", "h"), columns("orientation").ravel(), columns("weight").ravel(),
            columns("centre_x", "centre_y"), table.get("id", ()), unit_mm, **others,
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as a dict for JSON; ``plan.schema.json`` describes it.

        Its keys are ``version``, ``unit_mm``, ``bins`` (rows W, D, H), ``boxes`` and, if there are
        any, ``orders``, ``left_out`` and ``explanations`` (:class:`Explanation`, or None for a box
        without one). Each box is a dict with the keys :data:`BOX`, and those of
        :data:`marl_pack.plan_columns.EXTRAS` where its value is not the default.
        """
        boxes = [dict(zip(BOX, row, strict=True)) for row in self._rows()]
        for extra in EXTRAS:
            for box, value in zip(boxes, getattr(self, extra.field).tolist(), strict=True):
                if not extra.is_default(value):
                    box[extra.key] = value
        sizes = self.bin_sizes.tolist()
        content = {"version": VERSION, UNIT: self.unit_mm, "bins": sizes, "boxes": boxes}
        if self.orders:
            content["orders"] = list(self.orders)
        if self.left_out:
            content["left_out"] = [
                dict(zip(LEFT_OUT, (box.id, *box.sides, box.reason), strict=True))
                for box in self.left_out
            ]
        if any(self.explanations):
            content["explanations"] = self._reasons()
        return content

    @classmethod
    def of_dict(cls, content: Any, source: str) -> Plan:
        """Return the plan that a dict describes; :meth:`to_dict` returns such a dict.

        Args:
            content: the dict, or another value that was read from JSON.
            source: name of the file, for messages.

        Raises:
            ValueError: if ``content`` is not such a dict, or has an impossible value.
        """
        prefix = f"{source}: not a plan in JSON"
        if not isinstance(content, dict):
            raise ValueError(f"{prefix}: needs an object with the keys {', '.join(KEYS)}")
        version = content.get("version", VERSION)
        if version not in range(1, VERSION + 1) or isinstance(version, bool):
            raise ValueError(f"{prefix}: version {version!r}: needs 1 … {VERSION}")
        check_names(content, (*KEYS, *OPTIONAL), KEYS, prefix, "key")
        sizes, boxes = content["bins"], content["boxes"]
        try:
            if not isinstance(boxes, list) or not all(isinstance(box, dict) for box in boxes):
                raise ValueError("boxes: needs a list of objects")
            if not isinstance(sizes, list) or not all(isinstance(size, list) for size in sizes):
                raise ValueError("bins: needs a list of W, D, H")
            for size in sizes:
                for side in size:
                    real_number(side, "bins")
            for k, box in enumerate(boxes):
                check_names(box, (*BOX, *(e.key for e in EXTRAS)), BOX, f"box {k}", "key")
            rows = [[box[key] for key in BOX] for box in boxes]
            others: dict[str, Any] = {extra.field: [] for extra in EXTRAS}
            for k, (row, box) in enumerate(zip(rows, boxes, strict=True)):
                _check_row(row, f"box {k}")
                for extra in EXTRAS:
                    value = extra.of_json(box[extra.key]) if extra.key in box else extra.default
                    others[extra.field].append(value)
            others["left_out"] = _left_out(content.get("left_out", []))
            others["orders"] = content.get("orders", [])
            if not isinstance(others["orders"], list):
                raise ValueError("orders: needs a list of texts")
            others["explanations"] = _explanations(content.get("explanations", []))
            if content[UNIT] is not None:
                real_number(content[UNIT], UNIT)
        except ValueError as error:
            raise ValueError(f"{prefix}: {error}") from None
        try:
            return cls._of_rows(sizes, rows, content[UNIT], **others)
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from None

    def _reasons(self) -> list[dict[str, Any] | None]:
        """Return the explanations for JSON; an empty list if there are none."""
        if not any(self.explanations):
            return []
        return [None if why is None else why.to_dict() for why in self.explanations]

    def to_json(self, path: str | Path) -> None:
        """Write the plan as JSON (:meth:`to_dict`)."""
        write_json(Path(path), self.to_dict())

    @classmethod
    def from_json(cls, path: str | Path) -> Plan:
        """Read a plan that :meth:`to_json` wrote.

        Raises:
            ValueError: if the file is of another kind, or has an impossible value.
        """
        return cls.of_dict(read_json(Path(path)), str(path))

    def to_lines(self, extras: bool = False) -> list[list[Any]]:
        """Return the values of :data:`COLUMNS` for each box, in order, then for each empty bin.

        The line of an empty bin has no values but the bin's number, its size and the unit.

        Args:
            extras: whether to add the values of :data:`marl_pack.plan_columns.EXTRAS`.
        """
        unit = "" if self.unit_mm is None else self.unit_mm
        sizes = self.bin_sizes.tolist()
        lines = [[*row, *sizes[row[1]], unit] for row in self._rows()]
        used = set(self.bins.tolist())
        nothing = [""] * (len(BOX) - 2)
        empty = [["", k, *nothing, *size, unit] for k, size in enumerate(sizes) if k not in used]
        if extras:
            for extra in EXTRAS:
                values = getattr(self, extra.field).tolist()
                for line, value in zip(lines, values, strict=True):
                    line.append(extra.to_text(value))
            empty = [[*line, *[""] * len(EXTRAS)] for line in empty]
        return lines + empty

    @classmethod
    def of_lines(cls, lines: Sequence[Sequence[str]], source: str) -> Plan:
        """Return the plan of the lines of a CSV file.

        Args:
            lines: the lines that :meth:`to_lines` returns, with all values as text.
            source: name of the file, for messages.

        Raises:
            ValueError: if the lines are of another kind, or have an impossible value.
        """
        sizes: dict[int, list[Any]] = {}
        rows, units = [], set()
        others: dict[str, Any] = {extra.field: [] for extra in EXTRAS}
        for number, line in enumerate(lines):
            try:
                if len(line) not in (len(COLUMNS), len(ALL_COLUMNS)):
                    raise ValueError(f"has {len(line)} values, needs {len(COLUMNS)}")
                cells = [*line[len(COLUMNS) :]] or [""] * len(EXTRAS)
                name, index, *values, width, depth, height, unit = line[: len(COLUMNS)]
                size = [number_in(side) for side in (width, depth, height)]
                row: list[Any] = [name, number_in(index)]
                if name or any(values):
                    row += map(number_in, values)
                    _check_row(row, "it")
                    rows.append(row)
                    for extra, cell in zip(EXTRAS, cells, strict=True):
                        others[extra.field].append(extra.of_text(cell))
                if sizes.setdefault(row[1], size) != size:
                    raise ValueError(f"bin {row[1]} has different sizes")
                units.add(number_in(unit) if unit else None)
            except ValueError as error:
                raise ValueError(f"{source}: box {number}: {error}") from None
        if len(units) != 1 or sorted(sizes) != list(range(len(sizes))):
            raise ValueError(f"{source}: needs one unit, and bins numbered from 0 without a gap")
        try:
            return cls._of_rows([sizes[k] for k in sorted(sizes)], rows, units.pop(), **others)
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from None

    def to_csv(self, path: str | Path) -> None:
        """Write the plan as CSV: the names of the columns, then :meth:`to_lines`.

        CSV files have neither the boxes that had no place nor explanations.
        """
        extras = self.has_extras
        columns = ALL_COLUMNS if extras else COLUMNS
        write_csv(Path(path), [columns, *self.to_lines(extras)])

    @classmethod
    def from_csv(cls, path: str | Path) -> Plan:
        """Read a plan that :meth:`to_csv` wrote.

        Raises:
            ValueError: if the file is of another kind, or has an impossible value.
        """
        path = Path(path)
        (_, header), *lines = list(read_lines(path)) or [(0, [])]
        if header not in (list(COLUMNS), list(ALL_COLUMNS)) or not lines:
            raise ValueError(f"{path}: needs the columns {','.join(COLUMNS)} and at least one line")
        return cls.of_lines([line for _, line in lines], str(path))


def _numbers(name: str, values: Any, shape: tuple[int, ...]) -> Array:
    """Return numbers as a new array of ``shape``; refuse other shapes and infinite numbers."""
    array = np.array(values)
    array = array if array.size else array.reshape(shape)
    if array.shape != shape:
        raise ValueError(f"{name}: shape {array.shape}, needs {shape}")
    if array.size and (array.dtype.kind not in "iuf" or not np.isfinite(array).all()):
        raise ValueError(f"{name}: needs finite numbers")
    return array


def _check_row(row: Sequence[Any], what: str) -> None:
    """Refuse a box whose values, in the order of :data:`BOX`, are not numbers where needed."""
    for key, value in zip(BOX, row, strict=True):
        if key in ("bin", "orientation"):
            whole_number(value, f"{what}: {key}", -1)
        elif key != "id":
            real_number(value, f"{what}: {key}")


def _left_out(rows: Any) -> tuple[LeftOut, ...]:
    """Return the boxes without a place in JSON.

    Raises:
        ValueError: naming the box and what it needs.
    """
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("left_out: needs a list of objects")
    boxes = []
    for k, row in enumerate(rows):
        check_names(row, LEFT_OUT, LEFT_OUT, f"left_out: box {k}", "key")
        sides = tuple(real_number(row[key], f"left_out: box {k}: {key}") for key in "wdh")
        if not all(isinstance(row[key], str) for key in ("id", "reason")):
            raise ValueError(f"left_out: box {k}: id and reason need texts")
        boxes.append(LeftOut(row["id"], (sides[0], sides[1], sides[2]), row["reason"]))
    return tuple(boxes)


def _explanations(rows: Any) -> list[Explanation | None]:
    """Return the explanations in JSON; null where a box has none.

    Raises:
        ValueError: naming the explanation and what it needs.
    """
    if not isinstance(rows, list):
        raise ValueError("explanations: needs a list")
    return [
        None if row is None else Explanation.of_dict(row, f"explanation {k}")
        for k, row in enumerate(rows)
    ]


def _volume(sides: Array) -> float:
    """Return the total volume of boxes [n, 3], as a float because int64 may overflow."""
    return float(sides.astype(np.float64).prod(1).sum())
