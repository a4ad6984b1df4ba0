"""Sizes and bounds of afterstates and their values."""

MOST_LENGTHS = 5
"""Largest number of different side lengths of the next boxes."""

ILLEGAL = -1e6
"""Value of an illegal placement, less than that of any legal one."""

SHARES = 10
"""Number of classes of heights: tenths of the bin's height."""
STEPS = 6
"""Number of classes of steps between neighbouring columns, in tenths of the bin's height."""
SURFACE = SHARES + 1 + STEPS
"""Number of entries that describe the surface of an afterstate."""
