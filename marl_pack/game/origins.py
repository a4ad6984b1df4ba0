"""Numbers that say which games a saved state belongs to: their items, options and seed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor

from marl_pack.game.spec import GameSpec
from marl_pack.items import Stream, fingerprint


def origin(stream: Stream, spec: GameSpec, seed: int) -> dict[str, Tensor]:
    """Return numbers that identify the items, the options and the seed of games."""
    options = hashlib.blake2b(repr(spec.to_dict()).encode(), digest_size=7).digest()
    return {
        "items_fingerprint": torch.tensor(fingerprint(stream)),
        "options_fingerprint": torch.tensor(int.from_bytes(options, "little")),
        "seed": torch.tensor(seed % 2**63),
    }


def without_origin(
    tensors: Mapping[str, Tensor], origin: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return a state without the numbers of :func:`origin`.

    Args:
        tensors: the state of games.
        origin: the numbers of the games that will load it.

    Raises:
        ValueError: if the state belongs to games with other items, options or another seed.
    """
    rest = dict(tensors)
    for name, expected in origin.items():
        number = rest.pop(name, expected)  # the games are played again in any case
        same = isinstance(number, Tensor) and number.dtype == expected.dtype
        if not same or not torch.equal(number.cpu(), expected):
            part = name.removesuffix("_fingerprint")
            changed = "; was their file changed?" if part == "items" else ""
            raise ValueError(f"state of another game: needs the {part} of this game{changed}")
    return rest
