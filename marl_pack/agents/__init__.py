"""The players: policies that choose an orientation and a cell in each of G games."""

import os

# rsl_rl's logger imports GitPython, which cannot be imported without git unless this is set.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
