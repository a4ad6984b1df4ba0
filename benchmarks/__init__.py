"""Benchmarks of speed; each module is a command: ``python -m benchmarks.masks``.

Figures are CPU time on one thread, the best of several repetitions. Compare them only within one
run: machines differ, and the speed of one machine varies from minute to minute. The figures are
stored in ``results/``, each with the command that made it.
"""
