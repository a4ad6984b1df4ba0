"""Check parameters of stability rules and items: area thresholds and centres of mass."""

from __future__ import annotations

from marl_pack.checks import real_number, shown, whole_number

Thresholds = tuple[tuple[float, int], ...]

PAPER: Thresholds = ((0.60, 4), (0.80, 3), (0.95, 0))
"""The thresholds in the paper of Zhao et al. 2021, as pairs (share, corners). A box is stable if,
for one of the pairs, more than this share of its bottom face and at least this number of its
corners are supported."""
CODE: Thresholds = ((0.50, 4), (0.85, 3), (0.95, 0))
"""The thresholds in the code that Zhao et al. released."""
THRESHOLDS = {"paper": PAPER, "code": CODE}
"""The thresholds by name."""

NO_OFFSET = (0.0, 0.0, 0.0)


def check_com_offset(offset: tuple[float, ...]) -> tuple[float, float, float]:
    """Check the offset of a centre of mass and return it as three floats.

    Raises:
        ValueError: unless there are three numbers, each strictly between -0.5 and 0.5.
    """
    try:
        values = tuple(real_number(f, "com_offset") for f in offset)
    except TypeError:  # not a sequence
        values = ()
    if len(values) != 3 or not all(-0.5 < f < 0.5 for f in values):
        raise ValueError(
            f"com_offset {shown(offset)}: needs three fractions of the item's own sides w, d, h, "
            "each strictly between -0.5 and 0.5 (0 is the geometric centre)"
        )
    return values[0], values[1], values[2]


def check_thresholds(thresholds: Thresholds | str) -> Thresholds:
    """Check thresholds, a name (``"paper"``, ``"code"``) or pairs, and return them as pairs.

    Raises:
        ValueError: for an unknown name, a share outside [0, 1] or corners outside 0 … 4.
    """
    if isinstance(thresholds, str):
        if thresholds not in THRESHOLDS:
            names = ", ".join(THRESHOLDS)
            raise ValueError(f"area_ratio thresholds {thresholds!r}: needs one of {names}")
        return THRESHOLDS[thresholds]
    try:
        pairs = tuple(
            (real_number(share, "share"), whole_number(corners, "corners", 0, 4))
            for share, corners in thresholds
        )
    except (TypeError, ValueError):
        pairs = ()
    if not pairs or not all(0 <= share <= 1 for share, _ in pairs):
        raise ValueError(
            f"area_ratio thresholds {shown(thresholds)}: need pairs (share in [0, 1], whole number"
            " of corners in 0 … 4)"
        )
    return pairs
