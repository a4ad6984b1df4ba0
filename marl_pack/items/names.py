"""Check names of columns, keys and arrays; suggest the nearest valid name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from marl_pack import renamed

SYNONYMS: dict[str, tuple[str, ...]] = {
    "amount": ("quantity",),
    "article": ("id", "ids"),
    "boxes": ("items",),
    "count": ("quantity",),
    "depth": ("d",),
    "episode": ("sequence",),
    "group": ("sequence",),
    "height": ("h",),
    "length": ("w", "d"),
    "mass": ("weight", "weights"),
    "name": ("id", "ids"),
    "order": ("sequence",),
    "order_id": ("sequence",),
    "qty": ("quantity",),
    "side_up": ("upright",),
    "sku": ("id", "ids"),
    "this_side_up": ("upright",),
    "width": ("w", "d"),
}
"""Names that other programs use → the valid names that they may stand for."""


LENGTH = re.compile(r"(w|d|h|width|depth|length|height)([ _/(\[].*)?")
"""Names of lengths, whatever their unit."""


def check_names(
    names: Iterable[str], valid: Sequence[str], required: Sequence[str], source: str, what: str
) -> None:
    """Refuse names that are unknown or missing.

    Args:
        names: the names to check.
        valid: the names that may be used.
        required: the names that may not be missing.
        source: the file or argument, for the message.
        what: what they name: a column, key, array or attribute.

    Raises:
        ValueError: naming what is missing or unknown, the nearest valid name and all valid names.
    """
    used = list(names)
    missing = [name for name in required if name not in used]
    unknown = [name for name in used if name not in valid]
    problems = []
    in_mm = [name for name in unknown if str(name).endswith("_mm")]
    if in_mm and "w" in valid:
        problems.append(f"{what} {in_mm[0]!r} is for games in millimetres (--world mm)")
    elif "w_mm" in valid and any(LENGTH.fullmatch(str(name).strip().lower()) for name in unknown):
        problems.append("lengths need to be in millimetres, in w_mm, d_mm and h_mm")
    if missing:
        problems.append(f"no {what} {', '.join(map(repr, missing))}")
    if unknown:
        near = _nearest(unknown[0], [name for name in valid if name not in used])
        problems.append(f"unknown {what} {unknown[0]!r}{renamed.did_you_mean(near)}")
    if problems:
        text = "; ".join(problems)
        end = "" if unknown else "."
        raise ValueError(f"{source}: {text}{end} {what.capitalize()}s: {', '.join(valid)}")


def _nearest(name: str, free: Sequence[str]) -> str | None:
    """Return the name of ``free`` that ``name`` most probably means, or None."""
    plain = "_".join(str(name).lower().replace("-", " ").split())
    same = [other for other in (plain, *SYNONYMS.get(plain, ())) if other in free]
    return same[0] if same else renamed.nearest(plain, free)
