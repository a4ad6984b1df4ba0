"""Archives of many plans: the ``.npz`` files that ``evaluate --save-stacks`` writes.

Shapes use the letters E (plans), M (the most boxes of any plan) and B (the most bins of any plan).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_pack.files import write_atomically
from marl_pack.inputs import read_arrays
from marl_pack.items.names import check_names
from marl_pack.plan import UNIT, Plan

NOT_PLANS = "not a file of plans, as evaluate --save-stacks writes it"
REQUIRED = ("bin", "count", "boxes", "loads")
NAMES = (*REQUIRED, "utilization", "orientations", "ids", "bins", UNIT)
"""Names of the arrays of an archive."""


def save_plans(path: Path, plans: Sequence[Plan]) -> None:
    """Save plans as ``.npz``, rows past a plan's number of boxes filled with zeros.

    The arrays are ``bin`` ([3], or [E, B, 3] unless every plan has one bin of the same size),
    ``count`` [E], ``boxes`` [E, M, 6], ``loads`` [E, M, 3], ``utilization`` [E], ``orientations``,
    ``ids`` and ``bins`` [E, M], and ``unit_mm`` [E] (NaN: abstract cells).

    Raises:
        ValueError: if there are no plans.
    """
    if not plans:
        raise ValueError(f"{path}: there are no plans to save")
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
    write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def _padded(rows: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Stack arrays [n, …] of different n as [E, M, …], filled with zeros."""
    most = max(1, *map(len, rows))
    table = np.zeros((len(rows), most, *rows[0].shape[1:]), np.result_type(*rows))
    for filled, own in zip(table, rows, strict=True):
        filled[: len(own)] = own
    return table


def load_plans(path: str | Path) -> list[Plan]:
    """Read an archive of plans, also one without orientations, ids, bins and units.

    Raises:
        ValueError: if it is another kind of file, or for an impossible value.
    """
    try:
        arrays = read_arrays(Path(path))
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
        and all(arrays[key].shape == (e, most) for key in ("orientations", "ids", "bins"))
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
        try:
            plans.append(Plan(
                sizes[k][(sizes[k] != 0).any(1)], arrays["bins"][k, :n], boxes[k, :n, :3],
                boxes[k, :n, 3:], arrays["orientations"][k, :n], loads[k, :n, 0],
                loads[k, :n, 1:], tuple(arrays["ids"][k, :n].tolist()),
                None if np.isnan(unit) else unit,
            ))  # fmt: skip
        except ValueError as error:
            raise ValueError(f"{path}: episode {k}: {error}") from None
    return plans
