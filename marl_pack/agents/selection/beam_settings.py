"""The settings of the beam search over known boxes (``--plan width=8,depth=4``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from marl_pack.checks import whole_number
from marl_pack.settings_text import count, settings_in

if TYPE_CHECKING:
    from marl_pack.game.selection import SelectionPacking

MOST_WIDTH = 1024
"""Largest number of nodes at each depth."""
MOST_DEPTH = 64
"""Largest number of boxes to place in a search."""
NEEDS = "a beam over known boxes needs width=W or depth=D"


@dataclass(frozen=True)
class BeamSettings:
    """How far a beam search looks.

    Args:
        width: number of nodes that are kept at each depth.
        depth: number of boxes to place, at most those that are known; None for all of them.
    """

    width: int = 8
    depth: int | None = None

    def __post_init__(self) -> None:
        whole_number(self.width, "width", 1, MOST_WIDTH)
        if self.depth is not None:
            whole_number(self.depth, "depth", 1, MOST_DEPTH)

    def depth_in(self, game: SelectionPacking) -> int:
        """Return the number of boxes to place in a game: no more than are known."""
        known = game.k + game.preview
        return known if self.depth is None else min(self.depth, known)

    def __str__(self) -> str:
        return f"width={self.width}" + ("" if self.depth is None else f",depth={self.depth}")

    @classmethod
    def parse(cls, text: str) -> BeamSettings:
        """Read settings such as ``"width=8,depth=4"``; missing settings get defaults.

        Raises:
            ValueError: if the text has another form; the message says which form is needed.
        """
        return cls(**settings_in(text, {"width": count, "depth": count}, NEEDS))
