"""How fast is it told what placements leave? ``python -m benchmarks.room``.

Every legal placement of the visible items in bins that random play has begun to fill: in how many
cells each box that may come could be set down afterwards, by sets of cells as bits (floors of up to
128 cells), by compiled masks, and by tensor code.
"""

from __future__ import annotations

from unittest import mock

import torch

from benchmarks.timing import best_time, devices, show
from marl_pack.agents.afterstates import bitboards
from marl_pack.agents.afterstates.afterstates import _left_torch, afterstates_of, probe_lengths
from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    rows = []
    for n, size, sides in ((64, (10, 10, 10), (2, 5)), (8, (20, 20, 20), (4, 10))):
        game = Packing(n, size, sides=sides, seed=1)
        policy = make_policy("random", seed=1)
        for _ in range(6):
            game.place(*policy(game))
        boxes = game.orient_item(game.items, game.weights).sides
        lengths = probe_lengths(*game.stream.sides)
        placements = len(afterstates_of(game.bins, boxes, game.mask, lengths).counts)

        def seconds(code: object, device: str, game: Packing = game) -> float:
            known = (
                game.bins.to(device),
                game.orient_item(game.items, game.weights).sides.to(device),
            )
            mask, reach = game.mask.to(device), probe_lengths(*game.stream.sides)
            return best_time(lambda: code(*known, mask, reach), 5, device)  # type: ignore[operator]  # either code

        with mock.patch.object(bitboards, "hold", return_value=False):
            masks = seconds(afterstates_of, "cpu")
        ways = [("compiled masks", "cpu", masks)]
        if bitboards.hold(*size[:2]):
            ways.insert(0, ("sets of bits", "cpu", seconds(afterstates_of, "cpu")))
        ways += [("tensor code", device, seconds(_left_torch, device)) for device in devices()]
        for name, device, time in ways:
            rows.append(
                [f"{size[0]}³, sides {sides[0]}-{sides[1]}", name, device,
                 f"{1e6 * time / placements:,.2f}", f"{1e6 * time / n:,.0f}",
                 f"{masks / time:.2g}"]
            )  # fmt: skip
    show(
        "what each placement leaves",
        ["bin", "by", "device", "µs a placement", "µs an item", "times compiled masks"],
        rows,
    )


if __name__ == "__main__":
    main()
