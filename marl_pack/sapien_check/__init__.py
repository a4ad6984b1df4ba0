"""Physics has the last word: SAPIEN builds a stack box by box and says what moved.

Independent of how a stack was made: :class:`Stack` takes boxes in cells and makes metres of them,
:func:`check` judges the stack after its last placement and :func:`judge` after each.
``python -m marl_pack.sapien_check --help`` lists the commands.
"""

from marl_pack.sapien_check.judge import (
    Judged,
    Pass,
    Physics,
    SimulationError,
    Verdict,
    check,
    judge,
    judge_all,
)
from marl_pack.sapien_check.stack import Stack

__all__ = [
    "Judged",
    "Pass",
    "Physics",
    "SimulationError",
    "Stack",
    "Verdict",
    "check",
    "judge",
    "judge_all",
]
