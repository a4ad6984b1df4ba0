"""Experiments on packing and learning; each module is a command: ``python -m experiments.packing``.

Each keeps its figures in ``results/``, goes on where it was stopped, and measures only what is not
there yet; ``--only`` chooses rows, ``--again`` measures them once more. ``python -m
experiments.page`` makes docs/results.md of them.
"""
