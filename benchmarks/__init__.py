"""Benchmarks of speed; each module is a command: ``python -m benchmarks.masks``.

Figures are CPU time on one thread, the best of several repetitions, and are meant as ratios within
one run: machines differ, and so does one machine from minute to minute. They are kept in
``results/``, each with what made it.
"""
