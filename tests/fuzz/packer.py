"""Packers that get random calls: undo, restore and the plan are checked by plain code."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from marl_pack import Packer, Placement, Plan

from .millimetres import random_options

Generator = np.random.Generator
KINDS = ("place",) * 8 + ("actual",) * 3 + ("undo", "next_bin", "skip", "restore")


def corners(box: Any, yaw: float) -> Any:
    """The corners of a rotated box seen from above, [4, 2]."""
    x, y, _, w, d, _ = box
    c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    own = np.array([(-w, -d), (w, -d), (w, d), (-w, d)]) / 2
    return own @ np.array([[c, s], [-s, c]]) + (x + w / 2, y + d / 2)


def depth(a: Any, b: Any) -> float:
    """By how much two convex polygons overlap; negative for a gap."""
    least = math.inf
    for polygon in (a, b):
        for k in range(4):
            edge = polygon[(k + 1) % 4] - polygon[k]
            normal = np.array((-edge[1], edge[0])) / np.linalg.norm(edge)
            p, q = a @ normal, b @ normal
            least = min(least, min(p.max(), q.max()) - max(p.min(), q.min()))
    return float(least)


def check_plan(plan: Plan, unit: float, tolerance: float) -> None:
    """Raise AssertionError if boxes overlap, float or reach out of their bin."""
    slack = 1.01 * unit  # reported poses are rounded to units
    for k in range(len(plan.bin_sizes)):
        bin = plan.in_bin(k)
        shapes = [corners(box, yaw) for box, yaw in zip(bin.boxes, bin.yaws, strict=True)]
        low, high = bin.positions[:, 2], bin.positions[:, 2] + bin.sides[:, 2]
        for shape in shapes:
            assert (shape > -slack).all(), "out of the bin"
            assert (shape < bin.bin_sizes[0, :2] + slack).all(), "out of the bin"
        assert (high <= bin.bin_sizes[0, 2] + slack).all(), "above the bin"
        supported = low < 1e-9
        for i, j in combinations(range(len(bin)), 2):
            common = depth(shapes[i], shapes[j])
            above = min(high[i], high[j]) - max(low[i], low[j])
            assert min(common, above) <= slack, "overlap"
            if common > -slack and abs(low[j] - high[i]) <= tolerance + 1e-6:
                supported[j] = True
        assert supported.all(), "floats"


def place(packer: Packer, box: dict[str, Any]) -> None:
    """Place a box as it was offered; with a buffer or a preview, show it or place a known one."""
    if packer.buffer + packer.preview == 1:
        offered = packer.offer(**box)
        assert packer.place(**box) == offered
    elif packer.needs_box:
        packer.show(**box)
    else:
        offered = packer.offer_next()
        assert packer.place_next() == offered


def case_of(seed: list[int]) -> None:
    """Make random calls and check them.

    Raises:
        ValueError: if the options refuse the goods.
        AssertionError: if a call does not do what it says.
    """
    generator = np.random.default_rng(seed)
    options, goods = random_options(generator)
    unit = options["unit_mm"]
    items = goods.pop("items")
    names = {"weights": "weight", "max_load": "max_load", "stackable": "stackable"}
    policy = str(generator.choice(["random", "max_contact", "dblf", "linear"]))
    if generator.random() < 0.5:
        buffer, preview, open_bins = generator.integers((1, 0, 1), (4, 3, 4)).tolist()
        options |= {"buffer": buffer, "preview": preview, "open_bins": open_bins}
    packer = Packer(policy=policy, bins=3, seed=3, **options)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "saved.json")

        def saved() -> Any:
            packer.save(path)
            return path.read_text(), packer.state, packer.plan

        for i in range(len(items)):
            box: dict[str, Any] = {names[key]: values[i].item() for key, values in goods.items()}
            box |= {"sides": items[i].tolist(), "id": str(i)}
            kind = KINDS[generator.integers(len(KINDS))]
            before = saved()
            try:
                if kind == "place":
                    place(packer, box)
                elif kind == "actual":
                    last = packer.placements[-1] if packer.placements else None
                    if isinstance(last, Placement):
                        x, y, _ = last.centre
                        error = generator.uniform(-1, 1, 3) * (0.02 * last.w, 0.02 * last.d, 3)
                        packer.actual((x + error[0], y + error[1], error[2]))
                elif kind == "skip":
                    packer.skip_next() if packer.waiting else packer.skip(**box)
                elif kind == "next_bin":
                    packer.next_bin()
                elif kind == "restore":
                    packer = Packer.restore(path)
                    assert saved() == before, "restore"
                elif packer.calls:
                    packer.undo()
                    continue
            except ValueError:
                assert saved() == before, "a refused call changed something"
                continue
            after = saved()
            if after[0] != before[0]:
                packer.undo()
                assert saved() == before, f"undo of {kind}"
                packer = Packer.restore(path)
                if kind == "place":
                    place(packer, box)
                    assert saved() == after, "place again"
        check_plan(packer.plan, unit, options.get("level_tolerance_mm", 0.0))


def cases(seed: int) -> Iterator[tuple[str, Callable[[], None]]]:
    """Yield packers without end: a name, and a function that plays and checks one."""
    for part in range(10**9):
        yield f"packer {seed}-{part}", lambda part=part: case_of([seed, part])
