"""Afterstates: the bin after each legal placement, its features and its value."""
