"""Numbers that bound afterstates and their values."""

MOST_LENGTHS = 5
"""Largest number of different side lengths of the next boxes."""

ILLEGAL = -1e6
"""Value of an illegal placement, less than that of any legal one."""
