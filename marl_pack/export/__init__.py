"""Write a checkpoint's agents as ONNX files, for rsl_rl, or as a smaller checkpoint to publish.

``marl-pack export CHECKPOINT`` writes ``orientation.onnx`` and ``placement.onnx`` into the
checkpoint's folder, and ``afterstate_critic.onnx`` if an agent sees the values of afterstates.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
