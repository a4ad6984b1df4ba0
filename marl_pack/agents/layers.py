"""Layers with the initial weights of PPO's actors and critics."""

from __future__ import annotations

import math

from torch import nn


def initialized(layer: nn.Conv2d | nn.Linear, gain: float = math.sqrt(2)) -> nn.Module:
    """Return the layer with orthogonal weights times ``gain`` and biases of 0."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
