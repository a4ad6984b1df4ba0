"""The settings of the search at decision time (``--plan``)."""

from __future__ import annotations

from dataclasses import dataclass

from marl_pack.checks import whole_number
from marl_pack.settings_text import count, settings_in

MOST = 1 << 20
"""Largest number of futures in one decision."""

NEEDS = "needs rollouts=K, top=M or depth=D (width=W goes with a buffer, a preview or several bins)"


@dataclass(frozen=True)
class SearchSettings:
    """The number of pairs and futures that a search tries, and the length of each future.

    Args:
        rollouts: number K of imagined futures for each pair, on average.
        top: number M of pairs (orientation, cell) to try.
        depth: number of items to place in each future before the orientation agent's critic
            estimates the rest of the return; None plays every future to its end.
    """

    rollouts: int = 16
    top: int = 8
    depth: int | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (value is None and name == "depth"):
                object.__setattr__(self, name, whole_number(value, f"plan: {name}", 1))
        if self.rollouts * self.top > MOST:
            raise ValueError(f"plan: rollouts · top = {self.rollouts * self.top}, at most {MOST:,}")

    def __str__(self) -> str:
        named = (f"{k}={v}" for k, v in vars(self).items() if v is not None)
        return f"plan {','.join(named)}"

    @classmethod
    def parse(cls, text: str) -> SearchSettings:
        """Read settings such as ``"rollouts=16,top=8,depth=3"``; missing settings get defaults.

        Raises:
            ValueError: if the text has another form; the message says which form is needed.
        """
        readers = dict.fromkeys(("rollouts", "top", "depth"), count)
        return cls(**settings_in(text, readers, NEEDS))
