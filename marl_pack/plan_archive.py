"""Archives of many plans, one for each episode: the files that ``evaluate --save-stacks`` writes.

The ending of the file's name says the format:

- ``.npz``: NumPy arrays, the smallest format and the fastest to read;
- ``.json``: an object with ``policy`` and ``plans``; each plan has the key ``episode`` and the keys
  of :meth:`marl_pack.plan.Plan.to_dict`;
- ``.csv``: a line for each box, with ``policy`` and ``episode`` before the columns of
  :meth:`marl_pack.plan.Plan.to_lines`.

Shapes use the letters E (plans), M (the most boxes of any plan) and B (the most bins of any plan).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.checks import shown
from marl_pack.files import write_atomically, write_csv, write_json
from marl_pack.inputs import read_arrays, read_json, read_lines
from marl_pack.items.names import check_names
from marl_pack.plan import Plan
from marl_pack.plan_columns import ALL_COLUMNS, COLUMNS, EXTRAS, UNIT

NOT_PLANS = "not a file of plans from evaluate --save-stacks"
REQUIRED = ("bin", "count", "boxes", "loads")
NAMES = (*REQUIRED, "utilization", "orientations", "ids", "bins", UNIT, *(e.key for e in EXTRAS))
"""Names of the arrays of an archive."""
ENDINGS = (".npz", ".json", ".csv")
OF_PLAN = ("policy", "episode")
"""The first columns of a CSV file of many plans."""


def check_ending(path: Path, option: str) -> None:
    """Raise ValueError unless the ending of ``path`` is one of :data:`ENDINGS`.

    Args:
        path: a file of plans.
        option: the option that was given this path, for the message.
    """
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"{option} {path}: needs one of the endings {', '.join(ENDINGS)}")


def save_plans(path: Path, plans: Sequence[Plan], policy: str = "") -> None:
    """Save plans as ``.json``, ``.csv`` or, with any other ending, as ``.npz``.

    Args:
        path: the file to write.
        plans: one plan for each episode, in order from episode 0.
        policy: name of the policy that packed the boxes; ``.npz`` files do not store it.

    Raises:
        ValueError: if there are no plans.
    """
    if not plans:
        raise ValueError(f"{path}: there are no plans to save")
    numbered = list(enumerate(plans))
    if path.suffix.lower() == ".json":
        content = [{"episode": e} | plan.to_dict() for e, plan in numbered]
        write_json(path, {"policy": policy, "plans": content})
    elif path.suffix.lower() == ".csv":
        extras = any(plan.has_extras for plan in plans)
        lines = ([policy, e, *line] for e, plan in numbered for line in plan.to_lines(extras))
        write_csv(path, [(*OF_PLAN, *(ALL_COLUMNS if extras else COLUMNS)), *lines])
    else:
        _save_arrays(path, plans)


def save_plan(path: Path, plan: Plan) -> None:
    """Save one plan as ``.json`` or ``.csv``; with any other ending, as an archive of one plan."""
    writers = {".json": plan.to_json, ".csv": plan.to_csv}
    write = writers.get(path.suffix.lower(), lambda path: save_plans(path, [plan]))
    write(path)


def _save_arrays(path: Path, plans: Sequence[Plan]) -> None:
    """Save plans as ``.npz``; rows after a plan's last box are filled with zeros.

    The arrays are ``bin`` ([3], or [E, B, 3] unless every plan has one bin of the same size),
    ``count`` [E], ``boxes`` [E, M, 6], ``loads`` [E, M, 3], ``utilization`` [E], ``orientations``,
    ``ids`` and ``bins`` [E, M], and ``unit_mm`` [E] (NaN: abstract cells). If a box has a value of
    :data:`marl_pack.plan_columns.EXTRAS`, there is an array [E, M] of each of them.
    """
    sizes = _padded([plan.bin_sizes for plan in plans])
    boxes = _padded([plan.boxes for plan in plans])
    if boxes.dtype.kind == "i" and boxes.max(initial=0) <= np.iinfo(np.int16).max:
        boxes = boxes.astype(np.int16)
    uniform = sizes.shape[1] == 1 and bool((sizes == sizes[0]).all())
    units = [np.nan if plan.unit_mm is None else plan.unit_mm for plan in plans]
    arrays: dict[str, Any] = {
        "bin": sizes[0, 0] if uniform else sizes,
        "count": np.array([len(plan) for plan in plans]),
        "boxes": boxes,
        "loads": _padded([plan.loads for plan in plans]),
        "utilization": np.array([plan.utilization for plan in plans]),
        "orientations": _padded([plan.orientations.astype(np.int8) for plan in plans]),
        "ids": _padded([np.array(plan.ids, np.str_) for plan in plans]),
        "bins": _padded([plan.bins for plan in plans]),
        UNIT: np.array(units),
    }
    for extra in EXTRAS if any(plan.has_extras for plan in plans) else ():
        arrays[extra.key] = _padded([getattr(plan, extra.field) for plan in plans])
    write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def _padded(rows: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Stack arrays [n, …] of different n as [E, M, …], filled with zeros."""
    most = max(1, *map(len, rows))
    table = np.zeros((len(rows), most, *rows[0].shape[1:]), np.result_type(*rows))
    for padded, row in zip(table, rows, strict=True):
        padded[: len(row)] = row
    return table


def load_plans(path: str | Path) -> list[Plan]:
    """Read an archive of plans, or a file of a single plan.

    Raises:
        ValueError: if the file is of another kind, or has an impossible value.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        return _load_json(path)
    if path.suffix.lower() == ".csv":
        return _load_csv(path)
    return _load_arrays(path)


def _load_json(path: Path) -> list[Plan]:
    """Read plans from JSON."""
    content = read_json(path)
    if not isinstance(content, dict) or "plans" not in content:
        return [Plan.of_dict(content, str(path))]
    check_names(content, ("policy", "plans"), ("plans",), str(path), "key")
    if not isinstance(content["plans"], list) or not content["plans"]:
        raise ValueError(f"{path}: {NOT_PLANS}: plans needs a list of plans")
    plans = []
    for e, entry in enumerate(content["plans"]):
        if not isinstance(entry, dict) or entry.get("episode") != e:
            raise ValueError(f"{path}: plan {e}: needs an object whose episode is {e}")
        fields = {key: value for key, value in entry.items() if key != "episode"}
        plans.append(Plan.of_dict(fields, f"{path}: episode {e}"))
    return plans


def _load_csv(path: Path) -> list[Plan]:
    """Read plans from CSV."""
    (_, header), *lines = list(read_lines(path)) or [(0, [])]
    if header[: len(OF_PLAN)] != list(OF_PLAN):
        return [Plan.from_csv(path)]
    if header not in ([*OF_PLAN, *COLUMNS], [*OF_PLAN, *ALL_COLUMNS]) or not lines:
        needs = ",".join((*OF_PLAN, *COLUMNS))
        raise ValueError(f"{path}: {NOT_PLANS}: needs the columns {needs} and at least one line")
    plans: list[Plan] = []
    for episode, group in groupby((line for _, line in lines), lambda line: line[1:2]):
        if episode != [str(len(plans))]:
            raise ValueError(
                f"{path}: needs the boxes of episode {len(plans)} together and before those of "
                f"{shown(episode[0] if episode else '')}"
            )
        boxes = [line[len(OF_PLAN) :] for line in group]
        plans.append(Plan.of_lines(boxes, f"{path}: episode {len(plans)}"))
    return plans


def _load_arrays(path: Path) -> list[Plan]:
    """Read plans from NumPy arrays; orientations, ids, bins and units may be missing."""
    try:
        arrays = read_arrays(path)
        check_names(arrays, NAMES, REQUIRED, str(path), "array")
    except ValueError as error:
        raise ValueError(f"{path}: {NOT_PLANS}{str(error).removeprefix(str(path))}") from None
    size, count, boxes, loads = (arrays[key] for key in REQUIRED)
    e, most = boxes.shape[:2] if boxes.ndim == 3 else (0, 0)
    arrays = {
        "orientations": np.full((e, most), -1), "ids": np.full((e, most), ""),
        "bins": np.zeros((e, most), np.int64), UNIT: np.full(e, np.nan),
    } | arrays  # fmt: skip
    sizes = np.broadcast_to(size, (e, 1, 3)) if size.shape == (3,) else size
    consistent = (
        boxes.shape == (e, most, 6) and loads.shape == (e, most, 3)
        and sizes.ndim == 3 and (len(sizes), sizes.shape[2]) == (e, 3)
        and all(
            arrays[key].shape == (e, most)
            for key in ("orientations", "ids", "bins", *(x.key for x in EXTRAS if x.key in arrays))
        )
        and count.shape == arrays[UNIT].shape == (e,) and count.dtype.kind in "iu" and e > 0
        and arrays[UNIT].dtype.kind in "iuf" and arrays["ids"].dtype.kind == "U"
        and (boxes.dtype.kind in "iu") == (size.dtype.kind in "iu")
        and bool(((count >= 0) & (count <= most)).all())
    )  # fmt: skip
    if not consistent:
        raise ValueError(f"{path}: {NOT_PLANS}: needs arrays of matching shapes")
    plans = []
    for k, n in enumerate(count.tolist()):
        unit = float(arrays[UNIT][k])
        extras: dict[str, Any] = {x.field: arrays[x.key][k, :n] for x in EXTRAS if x.key in arrays}
        try:
            plans.append(Plan(
                sizes[k][(sizes[k] != 0).any(1)], arrays["bins"][k, :n], boxes[k, :n, :3],
                boxes[k, :n, 3:], arrays["orientations"][k, :n], loads[k, :n, 0],
                loads[k, :n, 1:], tuple(arrays["ids"][k, :n].tolist()),
                None if np.isnan(unit) else unit,
                **extras,
            ))  # fmt: skip
        except ValueError as error:
            raise ValueError(f"{path}: episode {k}: {error}") from None
    return plans
