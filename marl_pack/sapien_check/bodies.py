"""The masses and centres of mass with which the judge simulates packed boxes.

A stability rule computes masks from given weights and centres of mass. The real ones may differ:
densities and centres of mass drawn at random show how well a guarantee holds outside its
assumptions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from marl_pack.plan import Plan
from marl_pack.sapien_check.stack import DENSITY, Stack, cell_of, offsets_of


@dataclass(frozen=True)
class Bodies:
    """Settings that give each box of a plan a mass and a centre of mass.

    Raises:
        ValueError: for an impossible value.
    """

    cell: float | None = None  # metres of a unit of length; None: see stack.cell_of
    density: tuple[float, float] | None = (
        None  # bounds of the drawn density (log-uniform), kg/m³; None: the plan's weights
    )
    com_spread: float = 0.0  # largest drawn shift of a centre of mass, in fractions of w, d, h
    seed: int = 0  # seed of the drawn densities and centres

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

        If no density is drawn, a box's mass is its weight in the plan times a unit of length³
        times the standard density. A plan does not say how high a centre of mass is in its box. It
        is put in the middle, which moves no tipping point.

        Args:
            plan: boxes in one bin.
            episode: number of the plan; with the seed it determines the drawn values.

        Raises:
            ValueError: if the stack is impossible; names the episode and the box.
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
        """Describe what is drawn at random; empty if nothing is."""
        words = []
        if self.density is not None:
            words.append(f"densities {self.density[0]:g} to {self.density[1]:g}")
        if self.com_spread:
            words.append(f"centres of mass up to {self.com_spread:g} off")
        return ", ".join(words)
