"""Layers with the initial weights of PPO's actors and critics."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor, nn


def initialized(layer: nn.Conv2d | nn.Linear, gain: float = math.sqrt(2)) -> nn.Module:
    """Return the layer with orthogonal weights times ``gain`` and biases of 0."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


@cache
def _fused_layer() -> Callable[..., Tensor] | None:
    """Return the operation to which torch.compile lowers a linear layer on a CPU, if there is one.

    It includes the activation, and takes a third of the time of a layer and a ReLU. It is not a
    public part of PyTorch, so other versions may not have it.
    """
    if not torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]  # torch's own
        return None
    operation: Callable[..., Tensor] | None
    operation = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
    return operation


def linear_relu(layer: nn.Module, inputs: Tensor) -> Tensor:
    """Return the rectified outputs of a linear layer, without gradients."""
    fused = _fused_layer() if inputs.device.type == "cpu" and len(inputs) else None
    if fused is None:
        return torch.relu(layer(inputs))
    return fused(inputs, layer.weight, layer.bias, "relu", [], "")
