"""Make the policies and the game in millimetres that the options of a command name."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from marl_pack.agents.sources import is_own, own_policy
from marl_pack.checks import LARGEST_SEED, whole_number
from marl_pack.evaluation.rollout import Rollout, batches_mm
from marl_pack.exact.packing import ExactPacking
from marl_pack.exact.policies import ExactPolicy, make_exact_policy
from marl_pack.exact.present import check_present
from marl_pack.exact.spec import ORDERS, ExactSpec
from marl_pack.exact.streams import GoodsStream, make_goods_stream
from marl_pack.items.generated import no_such_file
from marl_pack.option_record import given_options
from marl_pack.options import MM_POLICIES
from marl_pack.plan import Plan
from marl_pack.terminal import announce_compiling


@dataclass(frozen=True)
class SetupMm:
    """The policies and the game in millimetres that a command's options name."""

    policies: dict[str, ExactPolicy]  # by the name of the policy's row in the table
    stream: GoodsStream
    spec: ExactSpec
    present: Plan | tuple[()]  # boxes that are in every bin at first
    arguments: argparse.Namespace  # the parsed options

    def batches(
        self, policy: ExactPolicy, episodes: int, progress: Callable[[int], object]
    ) -> Iterator[Rollout]:
        """Play episodes in batches (:func:`marl_pack.evaluation.rollout.batches_mm`)."""
        return batches_mm(policy, self.game, episodes, progress, self.arguments.explain)

    def game(self, n: int, first_episode: int) -> ExactPacking:
        """Return ``n`` games without ``auto_reset``; the first plays episode ``first_episode``."""
        return ExactPacking(
            n, self.stream, spec=self.spec, present=self.present, auto_reset=False,
            first_episode=first_episode,
        )  # fmt: skip

    @property
    def settings(self) -> dict[str, Any]:
        """All options with the values of the game filled in, for a report."""
        paths = "json", "save_stacks"
        options = {key: value for key, value in vars(self.arguments).items() if key not in paths}
        return options | asdict(self.spec)

    def __str__(self) -> str:
        words = [str(self.arguments.items)]
        if self.arguments.length is not None:
            words.append(f"{self.arguments.length} boxes in an episode")
        if self.arguments.order == "draw":
            words.append(f"drawn with seed {self.arguments.seed}")
        return ", ".join((*words, str(self.spec)))


def choose_mm(arguments: argparse.Namespace, console: Console) -> SetupMm:
    """Return the policies and the game that the options name.

    Raises:
        ValueError, FileNotFoundError: if an option is impossible; says what would be right.
    """
    announce_compiling(console)
    seed = whole_number(arguments.seed, "--seed", 0, LARGEST_SEED)
    if arguments.items is None:
        raise ValueError("--world mm: needs --items FILE, a .csv or .json file with sizes in mm")
    if not Path(arguments.items).is_file():
        raise no_such_file(arguments.items, in_mm=True)
    spec = ExactSpec.of(given_options(arguments, ExactSpec))
    stream = make_goods_stream(
        arguments.items, spec, order=arguments.order or ORDERS[0], length=arguments.length,
        seed=seed,
    )  # fmt: skip
    policies = {
        name: make_exact_policy(own_policy(name) if is_own(name) else name, seed)
        for name in arguments.policy or MM_POLICIES[:1]
    }
    present: Plan | tuple[()] = ()
    if arguments.present is not None:
        if not arguments.present.is_file():
            raise FileNotFoundError(f"--present {arguments.present}: no such file")
        read = Plan.from_csv if arguments.present.suffix == ".csv" else Plan.from_json
        present = read(arguments.present)
        check_present(present, spec)  # refuses impossible boxes before the games begin
    return SetupMm(policies, stream, spec, present, arguments)
