"""Layers with the initial weights of PPO's actors and critics."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def initialized(layer: nn.Conv2d | nn.Linear, gain: float = math.sqrt(2)) -> nn.Module:
    """Return the layer with orthogonal weights times ``gain`` and biases of 0."""
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


def linear_relu(layer: nn.Module, inputs: Tensor) -> Tensor:
    """Return the rectified outputs of a linear layer, without gradients."""
    if inputs.device.type != "cpu" or not torch._C._has_mkldnn or not len(inputs):
        return torch.relu(layer(inputs))
    # The operation to which torch.compile lowers a layer on a CPU: it takes a third of the time.
    fused = torch.ops.mkldnn._linear_pointwise
    outputs: Tensor = fused(inputs, layer.weight, layer.bias, "relu", [], "")
    return outputs
