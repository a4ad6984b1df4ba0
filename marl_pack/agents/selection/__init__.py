"""Policies for games in which a box and a bin are selected first."""
