"""Write a checkpoint's agents for use elsewhere: ONNX, rsl_rl's own format, or to publish them.

``python -m marl_pack.export CHECKPOINT`` writes ``orientation.onnx`` and ``placement.onnx`` beside
the checkpoint, and ``afterstate_critic.onnx`` if an agent sees the values of afterstates.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
