"""The real masses and centres of mass of packed boxes, drawn at random or as packed.

A stability rule computes masks from the weights that it is given. The real ones may differ: drawn
densities and centres of mass show how well a guarantee holds outside its assumptions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from marl_pack.plan import Plan
from marl_pack.sapien_check.stack import DENSITY, Stack, cell_of, offsets_of


@dataclass(frozen=True)
class Bodies:
    """Settings by which boxes of a plan become bodies with a mass and a centre of mass.

    Raises:
        ValueError: for an impossible value.
    """

    cell: float | None = None  # metres of a unit of length; None: see stack.cell_of
    density: tuple[float, float] | None = (
        None  # kg/m³, drawn between (log-uniform); None: as packed
    )
    com_spread: float = 0.0  # centre of mass drawn up to so far off, in fractions of w, d, h
    seed: int = 0  # of the drawn densities and centres

    def __post_init__(self) -> None:
        low, high = self.density or (DENSITY, DENSITY)
        if not 0 < low <= high < np.inf:
            raise ValueError(f"density {low:g} to {high:g}: needs 0 < LOW <= HIGH, in kg/m³")
        if not 0 <= self.com_spread < 0.5:
            raise ValueError(
                f"com_spread = {self.com_spread:g}: needs a fraction from 0 to below 0.5"
            )
        if self.cell is not None and not 0 < self.cell < np.inf:
            raise ValueError(f"cell = {self.cell:g}: needs a positive length in metres")
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed}: needs 0 or more")

    def stacks(self, plans: Sequence[Plan], episodes: Iterable[int]) -> Iterator[Stack]:
        """Yield the stacks of the chosen plans."""
        return (self.stack(plans[e], e) for e in episodes)

    def stack(self, plan: Plan, episode: int) -> Stack:
        """Return the stack of one plan.

        As packed, a box has its weight in units³ of the standard density. A plan does not say how
        high a centre of mass lies in its box; it is put in the middle, which moves no tipping
        point.

        Args:
            plan: boxes in one bin.
            episode: number of the plan; with the seed it decides the drawn values.

        Raises:
            ValueError: naming the episode and the box, if the stack is impossible.
        """
        cell = cell_of(plan) if self.cell is None else self.cell
        rng = np.random.default_rng((self.seed, episode))
        low, high = self.density or (DENSITY, DENSITY)
        density = np.exp(rng.uniform(np.log(low), np.log(high), len(plan)))
        sides = plan.sides.astype(np.float64)
        volume = plan.weights if self.density is None else sides.prod(1)
        offset = offsets_of(plan)
        offset += rng.uniform(-self.com_spread, self.com_spread, (len(plan), 3))
        mass = density * volume * cell**3
        try:
            return Stack.of_plan(plan, cell=cell, mass=mass, com_offset=offset)
        except ValueError as error:
            raise ValueError(f"episode {episode}: {error}") from None

    def __str__(self) -> str:
        """Describe the bodies; empty if all are as packed."""
        words = []
        if self.density is not None:
            words.append(f"densities {self.density[0]:g} to {self.density[1]:g}")
        if self.com_spread:
            words.append(f"centres of mass up to {self.com_spread:g} off")
        return ", ".join(words)
