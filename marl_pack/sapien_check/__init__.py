"""The judge of stacks: it builds a stack box by box in SAPIEN (PhysX) and reports what moved.

It does not depend on how a stack was packed. :class:`Stack` is made from a
:class:`marl_pack.plan.Plan` or rows of boxes. :func:`check` judges a stack after its last
placement, :func:`judge` after each placement. :func:`run_trial` builds a stack as a robot would,
with its errors. ``marl-pack judge --help`` lists the commands.
"""

from marl_pack.sapien_check.judge import Judged, Verdict, check, judge, judge_all
from marl_pack.sapien_check.stack import Stack
from marl_pack.sapien_check.trials import Trial, TrialResult, run_trial, run_trials
from marl_pack.sapien_check.world import Pass, Physics, SimulationError

__all__ = [
    "Judged",
    "Pass",
    "Physics",
    "SimulationError",
    "Stack",
    "Trial",
    "TrialResult",
    "Verdict",
    "check",
    "judge",
    "judge_all",
    "run_trial",
    "run_trials",
]
