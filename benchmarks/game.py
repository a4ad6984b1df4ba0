"""Measure the speed of the game: ``python -m benchmarks.game``.

The games are random legal play with the masks of all six orientations at every step, including the
random choice. Measured are N games at once on every device, on a CUDA device also with each step
captured as a CUDA graph, the cost for several sizes of the grid, and one game through the
PettingZoo view.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from torch import Tensor

from benchmarks.record import Measurements
from benchmarks.timing import devices
from marl_pack import env_aec
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.policy import draw_placement
from marl_pack.backend import Backend
from marl_pack.game.packing import Packing


def steps_per_second(game: Packing, seconds: float = 1.0, repeats: int = 5) -> float:
    """Return items placed per second of CPU time (on CUDA wall time), the best of ``repeats``."""
    on_cpu = game.device.type == "cpu"
    clock = time.process_time if on_cpu else time.perf_counter
    policy = make_policy("random", 0, game.device)
    for _ in range(30):
        game.place(*policy(game))
    best = 0.0
    for _ in range(repeats):
        start, steps = clock(), 0
        while clock() - start < seconds:
            for _ in range(10):
                game.place(*policy(game))
            steps += 10 * game.n
            if not on_cpu:
                torch.cuda.synchronize()
        best = max(best, steps / (clock() - start))
    return best


def batched(measured: Measurements) -> None:
    """Measure steps per second for several numbers of games."""
    for device in devices():
        for n in (1, 64, 1024, 4096) if device == "cpu" else (1024, 4096, 16384, 65536):
            speed = steps_per_second(Packing(n, device=device))
            measured.keep(f"N = {n:,}, {device}", steps_per_second=speed)
        if device == "cuda":
            for n in (4096, 65536):
                captured(measured, n)
    for n in (64, 1024):
        speed = steps_per_second(Packing(n, backend=Backend.TENSOR))
        measured.keep(f"N = {n:,}, cpu, tensor code", steps_per_second=speed)


def tensors_of(part: object, path: str = "") -> dict[str, Tensor]:
    """Return the tensors in the attributes of ``part`` and of its parts, by their paths."""
    if isinstance(part, Tensor):
        return {path: part}
    if not type(part).__module__.startswith("marl_pack"):
        return {}
    return {
        at: tensor
        for name, value in vars(part).items()
        for at, tensor in tensors_of(value, f"{path}.{name}").items()
    }


def changing(game: Packing) -> dict[str, Tensor]:
    """Return the tensors of the games that a step reads and replaces."""
    parts = {
        "state": game.state, "moves": game.moves, "orientations": game.orientation_mask,
        "alive": game.alive,
    }  # fmt: skip
    return {
        at: tensor for name, part in parts.items() for at, tensor in tensors_of(part, name).items()
    }


def step_and_store(game: Packing, points: Tensor) -> dict[str, Tensor]:
    """Play one random step, and copy what it leaves into the tensors that it began with.

    Args:
        game: the games.
        points: float32 [2, N, 1] in [0, 1), which make the random choice.

    Returns:
        The tensors that the step began with. A captured graph needs their memory.
    """
    before = changing(game)
    game.place(*draw_placement(game, points=points), check=False)
    after = changing(game)
    if before.keys() != after.keys():
        raise RuntimeError(f"a step changes its tensors: {before.keys() ^ after.keys()}")
    for at, tensor in before.items():
        if tensor is not after[at]:
            tensor.copy_(after[at])
    return before


def captured(measured: Measurements, n: int, seconds: float = 1.0) -> None:
    """Measure a step that is captured once as a CUDA graph and then replayed.

    The replayed games must equal games that are played step by step from the same numbers.
    """
    game, other = Packing(n, device="cuda"), Packing(n, device="cuda")
    points = torch.rand(2, n, 1, device="cuda")
    torch.cuda.synchronize()  # the stream below must not begin before the games are ready
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]  # torch has no type for it
    with torch.cuda.stream(stream):
        for _ in range(3):
            step_and_store(game, points)
            other.place(*draw_placement(other, points=points), check=False)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        played = step_and_store(game, points)
    for _ in range(40):  # the capture itself plays nothing
        points.uniform_()
        graph.replay()
        other.place(*draw_placement(other, points=points), check=False)
    for at, tensor in changing(other).items():
        torch.testing.assert_close(played[at], tensor, rtol=0, atol=0, msg=at)
    best = 0.0
    for _ in range(5):
        start, steps = time.perf_counter(), 0
        while time.perf_counter() - start < seconds:
            for _ in range(10):
                points.uniform_()
                graph.replay()
            torch.cuda.synchronize()
            steps += 10 * n
        best = max(best, steps / (time.perf_counter() - start))
    measured.keep(f"N = {n:,}, cuda, captured", steps_per_second=best)


def scaling(measured: Measurements) -> None:
    """Measure steps per second for several sizes of the grid; the items grow with the bin."""
    for side in (10, 20, 40, 80, 160):
        n = max(4, 1024 * 100 // side**2)
        game = Packing(n, (side, side, side), sides=(side // 5, side // 2))
        each = 1 / steps_per_second(game, 0.5, 3)
        measured.keep(f"grid: {side}³", n=n, us_step=1e6 * each, ns_step_cell=1e9 * each / side**2)


def through_pettingzoo(measured: Measurements, seconds: float = 1.0, repeats: int = 5) -> None:
    """Measure turns per CPU second of one game through the AEC view with all its wrappers."""
    env = env_aec.env()
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    best = 0.0
    for _ in range(repeats):
        start, turns = time.process_time(), 0
        while time.process_time() - start < seconds:
            for agent in env.agent_iter():
                observation, _, terminated, truncated, _ = env.last()
                if terminated or truncated:
                    env.step(None)
                    continue
                legal = np.flatnonzero(observation["action_mask"])
                env.step(legal[generator.integers(len(legal))])
                turns += 1
                del agent
            env.reset()
        best = max(best, turns / (time.process_time() - start))
    measured.keep("PettingZoo, one bin", turns_per_second=best)


def main() -> None:
    """Measure all figures of this benchmark."""
    measured = Measurements("game", __doc__, seed=0)
    measured.parse()
    torch.set_num_threads(1)
    batched(measured)
    scaling(measured)
    through_pettingzoo(measured)


if __name__ == "__main__":
    main()
