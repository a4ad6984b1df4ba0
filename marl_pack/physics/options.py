"""Options of the commands that judge packings, for cells, densities and centres of mass."""

from __future__ import annotations

import argparse

from marl_pack.sapien_check.bodies import Bodies

BODY_OPTIONS = ("cell", "density", "com_spread")
"""Names of the options that :func:`add_body_options` adds; an option that is not used is None."""


def add_body_options(parser: argparse._ActionsContainer) -> None:
    """Add ``--cell``, ``--density`` and ``--com-spread`` to a command."""
    add = parser.add_argument
    add("--cell", type=float, metavar="METRES",
        help="edge of a cell (default: the unit in the plan; if it has none, the bin's longest "
             "side is 0.6 m)")  # fmt: skip
    add("--density", nargs=2, type=float, metavar=("LOW", "HIGH"),
        help="draw the density of each box at random between these values, in kg/m³ "
             "(default: the weights of the packing)")  # fmt: skip
    add("--com-spread", type=float, metavar="SHARE",
        help="draw the centre of mass of each box at random, up to this share of each side away "
             "from the centre in the packing (default: 0)")  # fmt: skip


def chosen_bodies(options: argparse.Namespace) -> Bodies:
    """Return the bodies that ``--cell``, ``--density``, ``--com-spread`` and ``--seed`` choose.

    Raises:
        ValueError: for an impossible value.
    """
    density = None if options.density is None else (options.density[0], options.density[1])
    return Bodies(options.cell, density, options.com_spread or 0.0, options.seed)
