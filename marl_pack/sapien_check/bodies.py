"""Packings as they were played, made into stacks: what the boxes weigh and where their centres are.

A stability rule knows the boxes by what it is told of them. Here the truth may differ: densities
and centres of mass drawn for each item show what a guarantee is worth outside its assumptions.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from marl_pack.sapien_check.stack import DENSITY, Stack, cell_size


class Packings(Protocol):
    """Packings of E episodes, as :class:`marl_pack.evaluate.Episodes` holds them."""

    @property
    def size(self) -> tuple[int, int, int]:
        """(W, D, H) in cells."""

    @property
    def packed(self) -> NDArray[np.int64]:
        """Number of boxes, [E]."""

    @property
    def boxes(self) -> NDArray[np.int16]:
        """Rows x, y, z, w, d, h in order of placement, [E, M, 6]."""

    @property
    def loads(self) -> NDArray[np.float64]:
        """Weight and x, y of the centre of mass of each box, as the rule was told, [E, M, 3]."""


@dataclass(frozen=True)
class Bodies:
    """What the boxes of a packing really are."""

    cell: float | None = None  # metres; None: the bin's longest side is 0.6 m
    density: tuple[float, float] | None = (
        None  # kg/m³, drawn between (log-uniform); None: as packed
    )
    com_spread: float = 0.0  # centre of mass drawn up to so far off, in fractions of w, d, h
    seed: int = 0  # of what is drawn

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

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        """Add the options of :meth:`from_options` to a command."""
        add = parser.add_argument
        add("--cell", type=float, metavar="METRES",
            help="edge of a cell (default: the bin's longest side is 0.6 m)")  # fmt: skip
        add("--density", nargs=2, type=float, metavar=("LOW", "HIGH"),
            help="density of each box, drawn between these, in kg/m³ "
                 "(default: as packed)")  # fmt: skip
        add("--com-spread", type=float, metavar="SHARE",
            help="centre of mass of each box, drawn up to this share of each side off "
                 "(default: 0)")  # fmt: skip

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> Bodies:
        """What a command's ``--cell``, ``--density``, ``--com-spread`` and ``--seed`` say."""
        density = None if options.density is None else (options.density[0], options.density[1])
        return cls(options.cell, density, options.com_spread or 0.0, options.seed)

    def stacks(self, played: Packings, episodes: Iterable[int]) -> Iterator[Stack]:
        """The stacks of the chosen episodes."""
        return (self.stack(played, e) for e in episodes)

    def stack(self, played: Packings, episode: int) -> Stack:
        """The stack of one episode.

        Weights are in cells of the standard density, or a file's. How high a centre of mass lies
        in its box was not kept; it is put in the middle, which moves no tipping point.

        Raises:
            ValueError: naming the episode and the box, if the stack cannot be.
        """
        n, size = int(played.packed[episode]), played.size
        boxes, loads = played.boxes[episode, :n], played.loads[episode, :n]
        sides = boxes[:, 3:].astype(np.float64)
        cell = cell_size(size) if self.cell is None else self.cell
        rng = np.random.default_rng((self.seed, episode))
        low, high = self.density or (DENSITY, DENSITY)
        drawn = np.exp(rng.uniform(np.log(low), np.log(high), len(boxes)))
        volume = loads[:, 0] if self.density is None else sides.prod(1)
        offset = np.zeros((len(boxes), 3))
        offset[:, :2] = (loads[:, 1:] - boxes[:, :2]) / sides[:, :2] - 0.5
        offset += rng.uniform(-self.com_spread, self.com_spread, (len(boxes), 3))
        mass = drawn * volume * cell**3
        try:
            return Stack.of_cells(size, boxes, cell=cell, mass=mass, com_offset=offset)
        except ValueError as error:
            raise ValueError(f"episode {episode}: {error}") from None

    def __str__(self) -> str:
        """In words, empty if all is as it was packed."""
        said = []
        if self.density is not None:
            said.append(f"densities {self.density[0]:g} to {self.density[1]:g}")
        if self.com_spread:
            said.append(f"centres of mass up to {self.com_spread:g} off")
        return ", ".join(said)
