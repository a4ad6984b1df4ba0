"""Run each trainer of ``examples/`` in its own environment: ``make trainers``, or ``nox -s sb3``.

Arguments after ``--`` go to the examples: ``nox -s sb3 report -- --minutes 10 --items 1000000``.
"""

import sys
from pathlib import Path

import nox

nox.options.default_venv_backend = "venv"
nox.options.reuse_existing_virtualenvs = True

EXAMPLES = {
    "cleanrl": "cleanrl_ppo",
    "torchrl": "torchrl_ppo",
    "rllib": "rllib_ppo",
    "benchmarl": "benchmarl_ippo",
    "sb3": "sb3_maskable_ppo",
    "tianshou": "tianshou_ppo",
    "skrl": "skrl_ippo",
    "agilerl": "agilerl_ippo",
}
IN_CI = ("torchrl", "rllib", "sb3", "tianshou")
BRIEFLY = ("--items", "2500", "--episodes", "50")
REPORTS = Path("build/trainers")
CONSTRAINTS = Path(__file__).with_name("constraints.txt")
TORCH = next(line for line in CONSTRAINTS.read_text().splitlines() if line.startswith("torch=="))


def add(trainer: str, example: str) -> None:
    """Define the session of one trainer."""

    @nox.session(name=trainer, tags=["all", "ci"] if trainer in IN_CI else ["all"])
    def train(session: nox.Session) -> None:
        report = REPORTS / f"{trainer}.json"
        report.unlink(missing_ok=True)
        report.parent.mkdir(parents=True, exist_ok=True)
        extra = "" if trainer == "cleanrl" else f"[{trainer}]"
        session.install(TORCH, "-e", f".{extra}")
        arguments = session.posargs or BRIEFLY
        session.run("python", f"examples/{example}.py", *arguments, "--json", str(report))


for trainer, example in EXAMPLES.items():
    add(trainer, example)


@nox.session(venv_backend="none", tags=["all", "ci"])
def report(session: nox.Session) -> None:
    """Print what each trainer did when it was last run."""
    session.run(  # with nox's own Python: marl_pack is beside it
        sys.executable, "examples/report.py", str(REPORTS), external=True
    )
