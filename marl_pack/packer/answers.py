"""What the packer answers: a placement, or no place and why."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Placement:
    """Where a box is placed. Lengths are in millimetres; it is true in a condition."""

    id: str  # "" where unknown
    bin: int  # number of the bin, from 0
    orientation: int  # row of marl_pack.geometry.ORIENTATIONS
    x: float  # low corner in the bin
    y: float
    z: float
    w: float  # sides along x, y, z, as placed
    d: float
    h: float
    centre: tuple[float, float, float]  # middle of the box in the bin
    support: float  # share of the footprint that rests on the floor or on boxes, 0 … 1
    margin: float | None  # distance of the centre of mass from the edge of its support; None if
    # nothing carries the box
    yaw: float = 0.0  # rotation about the vertical, degrees; only if the robot reported it
    problem: str = ""  # why a reported pose breaks the rule; "" if it does not
    number: int | None = None  # of the box if it was shown: the boxes that came before it

    placed: Literal[True] = True

    def __bool__(self) -> bool:
        return True

    def to_dict(self) -> dict[str, Any]:
        """Return the placement for JSON.

        It has yaw and problem only where a pose was reported, and a number only if the box was
        shown.
        """
        values = asdict(self)
        if self.number is None:
            del values["number"]
        if not self.yaw and not self.problem:
            del values["yaw"], values["problem"]
        return {"placed": values.pop("placed"), **values}


@dataclass(frozen=True)
class NoPlace:
    """A box has no place, and why; it is false in a condition."""

    id: str
    code: str  # a key of REASONS
    reason: str  # one sentence
    number: int | None = None  # of the box if it was shown: the boxes that came before it

    placed: Literal[False] = False

    def __bool__(self) -> bool:
        return False

    def to_dict(self) -> dict[str, Any]:
        """Return the answer for JSON; it has a number only if the box was shown."""
        values = {"placed": False, "id": self.id, "code": self.code, "reason": self.reason}
        return values if self.number is None else {**values, "number": self.number}


@dataclass(frozen=True)
class Waiting:
    """A box that was shown and is not placed yet; it is true in a condition."""

    number: int  # of the boxes that came before it, those that were placed or left out included
    id: str  # "" where unknown
    sides: tuple[float, float, float]  # own sides w, d, h in millimetres
    order: str  # name of its order; "" for none

    def to_dict(self) -> dict[str, Any]:
        """Return the answer for JSON: which box waits."""
        return {"waiting": True, "id": self.id, "number": self.number}


REASONS = {
    "too_large": "larger than the empty bin in every orientation that it may take",
    "too_thin": "lower than the level tolerance",
    "policy": "the policy chose no place, though there is one",
    "too_heavy": "the bin would become heavier than it may be",
    "unknown_weight": "the bin has a weight limit, and a weight is unknown",
    "other_order": "the open bin belongs to another order, and no more bins may be opened",
    "full": "the bin holds as many boxes as it may",
    "too_tall": "it would reach above the bin wherever it fits",
    "no_support": "nowhere would it stand by the rule and the margin",
    "load": "it would have to rest on boxes that may not carry it",
}
"""The reasons why a box has no place, by their code."""
