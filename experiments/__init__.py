"""Experiments on packing and learning; each module is a command: ``python -m experiments.packing``.

Each stores its figures in ``results/``, continues where it was stopped, and measures only rows
that are missing; ``--only`` chooses rows, ``--again`` measures them again. ``python -m
experiments.page`` makes docs/results.md from the figures.
"""
