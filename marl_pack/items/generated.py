"""The item streams that need no file: their names, and the sides of their items."""

GENERATED = ("rs", "cut1", "cut2")
"""Names of the streams that need no file."""

DEFAULT_SIDES = (2, 5)
"""Shortest and longest side of a generated item: the 64 types {2..5}³ of RS and CUT."""
