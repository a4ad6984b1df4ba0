"""The calls that change a packer, and the file that a packer is saved to.

A packer's state follows from its arguments and its calls, in order. So a file holds these, ``undo``
does all calls but the last again, and ``restore`` does all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from marl_pack.agents.sources import is_own
from marl_pack.checks import shown, whole_number
from marl_pack.exact.bins import placements
from marl_pack.exact.goods import DEFAULTS, KEYS, Goods, check_goods
from marl_pack.exact.lengths import to_mm
from marl_pack.exact.moves import encode
from marl_pack.exact.present import Present
from marl_pack.exact.spec import ExactSpec
from marl_pack.explanation import Explanation
from marl_pack.items.names import check_names
from marl_pack.packer.answers import REASONS
from marl_pack.packer.poses import Pose

FORMAT = "marl_pack packer"
VERSION = 1
BOX_ATTRIBUTES = {
    "id": "ids", "weight": "weights", "upright": "upright", "orientations": "orientations",
    "stackable": "stackable", "max_load": "max_load",
}  # fmt: skip
"""Attributes of a box in :meth:`marl_pack.packer.packer.Packer.place`, with their keys in goods."""


@dataclass(frozen=True)
class Placed:
    """A box was placed by a move."""

    item: Goods  # one row
    bin: int
    move: int
    order: str = ""
    explanation: Explanation | None = None


@dataclass(frozen=True)
class Reported:
    """A robot reported where it really put the last box."""

    pose: Pose


@dataclass(frozen=True)
class Skipped:
    """A box without a place was left out."""

    item: Goods  # one row
    code: str
    reason: str


@dataclass(frozen=True)
class Opened:
    """The next bin was opened."""


@dataclass(frozen=True)
class Shown:
    """A box of the conveyor was shown."""

    item: Goods  # one row
    order: str = ""


@dataclass(frozen=True)
class PlacedNext:
    """A visible box was placed by a move."""

    number: int  # of the box: the boxes that came before it
    bin: int
    move: int
    explanation: Explanation | None = None


@dataclass(frozen=True)
class SkippedNext:
    """A visible box without a place was left out."""

    number: int
    code: str
    reason: str


Call = Placed | Reported | Skipped | Opened | Shown | PlacedNext | SkippedNext


def goods_of(sides: Any, attributes: Mapping[str, Any], spec: ExactSpec) -> Goods:
    """Return a box as one row of goods; it need not fit into the bin.

    Args:
        sides: three numbers w, d, h in millimetres.
        attributes: values of :data:`BOX_ATTRIBUTES`.
        spec: the options of the bin.

    Raises:
        ValueError: if a value is impossible; says what would be right.
    """
    check_names(attributes, tuple(BOX_ATTRIBUTES), (), "box", "attribute")
    values = {
        BOX_ATTRIBUTES[key]: [value] for key, value in attributes.items() if value is not None
    }
    listed = isinstance(sides, Sequence | np.ndarray) and not isinstance(sides, str)
    if (
        not listed
        or len(sides) != 3
        or any(isinstance(s, bool | np.bool_) or not isinstance(s, Real) for s in sides)
    ):
        raise ValueError(f"box: {shown(sides)}: needs three lengths w, d, h in mm")
    return check_goods([list(sides)], spec, values, source="box", fit=False)


def _box(item: Goods) -> dict[str, Any]:
    """Return one row of goods for JSON; values that are the default are left out."""
    box: dict[str, Any] = {"sides": to_mm(item.sides[0], item.unit_mm).tolist()}
    if item.ids[0] != DEFAULTS["ids"]:
        box["id"] = str(item.ids[0])
    if not np.isnan(item.weights[0]):
        box["weight"] = float(item.weights[0])
    if not item.orientations[0].all():
        box["orientations"] = np.flatnonzero(item.orientations[0]).tolist()
    if not item.stackable[0]:
        box["stackable"] = False
    if np.isfinite(item.max_load[0]):
        box["max_load"] = float(item.max_load[0])
    return box


def _goods(box: Any, spec: ExactSpec) -> Goods:
    """Return the goods of a box in JSON."""
    if not isinstance(box, dict):
        raise ValueError(f"box {shown(box)}: needs an object")
    check_names(box, ("sides", *BOX_ATTRIBUTES), ("sides",), "box", "key")
    attributes = {key: value for key, value in box.items() if key != "sides"}
    return goods_of(box["sides"], attributes, spec)


def to_row(call: Call) -> dict[str, Any]:
    """Return a call for JSON."""
    if isinstance(call, Placed | PlacedNext):
        orientation, x, y, z = placements(call.move).tolist()
        where = {"bin": call.bin, "orientation": orientation, "units": [x, y, z]}
        why = {} if call.explanation is None else {"explanation": call.explanation.to_dict()}
        if isinstance(call, PlacedNext):
            return {"call": "place_next", "number": call.number, **where, **why}
        return {"call": "place", "box": _box(call.item), **where, "order": call.order, **why}
    if isinstance(call, Reported):
        return {"call": "actual", "pose": [call.pose.x, call.pose.y, call.pose.yaw]}
    if isinstance(call, Skipped):
        return {"call": "skip", "box": _box(call.item), "code": call.code, "reason": call.reason}
    if isinstance(call, Shown):
        return {"call": "show", "box": _box(call.item), "order": call.order}
    if isinstance(call, SkippedNext):
        return {
            "call": "skip_next", "number": call.number, "code": call.code, "reason": call.reason
        }  # fmt: skip
    return {"call": "next_bin"}


ROWS = {
    "place": ("box", "bin", "orientation", "units", "order"), "actual": ("pose",),
    "skip": ("box", "code", "reason"), "next_bin": (), "show": ("box", "order"),
    "place_next": ("number", "bin", "orientation", "units"),
    "skip_next": ("number", "code", "reason"),
}  # fmt: skip
"""The keys of each call in a file."""


def of_row(row: Any, spec: ExactSpec) -> Call:
    """Return the call of a row that :func:`to_row` made.

    Raises:
        ValueError: if it is not such a row.
    """
    if not isinstance(row, dict) or row.get("call") not in list(ROWS):
        raise ValueError(f"call {shown(row)}: needs an object whose call is one of {[*ROWS]}")
    name = row["call"]
    needed = ("call", *ROWS[name])
    allowed = (*needed, "explanation") if name in ("place", "place_next") else needed
    check_names(row, allowed, needed, f"call {name}", "key")
    if "order" in row and not isinstance(row["order"], str):
        raise ValueError(f"call {name}: order {shown(row['order'])}: needs a text")
    if "code" in row and (row["code"] not in list(REASONS) or not isinstance(row["reason"], str)):
        raise ValueError(f"call {name}: needs one of the codes {', '.join(REASONS)}, and a text")
    number = whole_number(row["number"], f"call {name}: number", 0) if "number" in row else 0
    if name == "place":
        return Placed(_goods(row["box"], spec), *_where(row), row["order"], _why(row))
    if name == "place_next":
        return PlacedNext(number, *_where(row), _why(row))
    if name == "actual":
        return Reported(Pose.of(row["pose"]))
    if name == "skip":
        return Skipped(_goods(row["box"], spec), row["code"], row["reason"])
    if name == "show":
        return Shown(_goods(row["box"], spec), row["order"])
    if name == "skip_next":
        return SkippedNext(number, row["code"], row["reason"])
    return Opened()


def _where(row: Mapping[str, Any]) -> tuple[int, int]:
    """Return the bin and the move in the row of a placement."""
    source = f"call {row['call']}"
    if not isinstance(row["units"], list) or len(row["units"]) != 3:
        raise ValueError(f"{source}: units {shown(row['units'])}: needs x, y, z")
    x, y, z = (whole_number(v, f"{source}: units", 0, 10**6) for v in row["units"])
    orientation = whole_number(row["orientation"], f"{source}: orientation", 0, 5)
    bin = whole_number(row["bin"], f"{source}: bin", 0)
    return bin, int(encode(orientation, x, y, z))


def _why(row: Mapping[str, Any]) -> Explanation | None:
    """Return the explanation in the row of a placement, if there is one."""
    source = f"call {row['call']}: explanation"
    return Explanation.of_dict(row["explanation"], source) if "explanation" in row else None


# --- files ----------------------------------------------------------------------------------------


def to_dict(
    spec: ExactSpec, arguments: Mapping[str, Any], present: Present, done: Sequence[Call]
) -> dict[str, Any]:
    """Return the content of a saved packer.

    Args:
        spec: its options.
        arguments: its other arguments; those that are not numbers or texts are not saved, nor is
            a policy ``FILE.py:NAME``, so that reading a file never runs code that it names.
        present: the boxes that were in the first bin.
        done: its calls.
    """
    texts = {
        key: str(value) if isinstance(value, Path) else value for key, value in arguments.items()
    }
    plain = {
        key: value
        for key, value in texts.items()
        if (value is None or isinstance(value, str | int | float)) and not is_own(value)
    }
    boxes = [
        {"box": _box(present.goods[[k]]), "row": to_mm(row, spec.unit_mm).tolist()}
        for k, row in enumerate(present.rows)
    ]
    return {
        "format": FORMAT, "version": VERSION, "options": asdict(spec), "arguments": plain,
        "not_saved": [key for key in texts if key not in plain], "present": boxes,
        "calls": [to_row(call) for call in done],
    }  # fmt: skip


def read(content: Any) -> tuple[dict[str, Any], list[Any]]:
    """Return the arguments of a saved packer and its calls, as they are in the file.

    Raises:
        ValueError: if the content is not that of a saved packer.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"not a saved packer: needs an object whose format is {FORMAT!r}")
    keys = ("format", "version", "options", "arguments", "not_saved", "present", "calls")
    check_names(content, keys, keys, "saved packer", "key")
    if content["version"] != VERSION:
        raise ValueError(f"version {shown(content['version'])}: needs {VERSION}")
    for key, kind in (
        ("options", dict), ("arguments", dict), ("not_saved", list), ("present", list),
        ("calls", list),
    ):  # fmt: skip
        if not isinstance(content[key], kind):
            raise ValueError(f"{key}: needs {'a list' if kind is list else 'an object'}")
    names = ("policy", "bins", "open_next", "buffer", "preview", "open_bins", "plan", "catalogue",
             "grid_mm", "seed", "explain")  # fmt: skip
    check_names(content["arguments"], names, (), "arguments", "key")
    made = {"spec": ExactSpec.of(content["options"]), **content["arguments"]}
    if content["present"]:
        made["present"] = _present(content["present"])
    made["not_saved"] = content["not_saved"]
    return made, content["calls"]


def _present(rows: Sequence[Any]) -> dict[str, Any]:
    """Return the boxes that were in the first bin, as a mapping for ``check_present``."""
    boxes: dict[str, list[Any]] = {"boxes": []}
    attributes = [key for key in BOX_ATTRIBUTES.items() if key[1] in KEYS]
    for row in rows:
        if (
            not isinstance(row, dict)
            or set(row) != {"box", "row"}
            or not isinstance(row["box"], dict)
        ):
            raise ValueError("present: needs objects with the keys box and row")
        boxes["boxes"].append(row["row"])
        for name, key in attributes:
            boxes.setdefault(key, []).append(row["box"].get(name))
    return {
        key: values
        for key, values in boxes.items()
        if key == "boxes" or any(value is not None for value in values)
    }


def complete(made: dict[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a packer from a file and from the user, who has the last word.

    Raises:
        ValueError: if an argument that could not be saved is not given.
    """
    made = dict(made)
    for name in made.pop("not_saved"):
        if name not in list(given):
            raise ValueError(f"{name} was not saved: restore needs it")
    return {**made, **given}
