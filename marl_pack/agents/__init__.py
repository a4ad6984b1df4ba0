"""The players: policies that turn the state of N bins into an orientation and a cell each."""

import os

# rsl_rl's logger imports GitPython, which else refuses to be imported where there is no git.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
