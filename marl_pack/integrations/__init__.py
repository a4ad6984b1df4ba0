"""Adapters for other trainers of the environment; ``examples/`` shows their use.

- :mod:`marl_pack.integrations.network`: a small masked actor-critic in plain PyTorch;
- one module for each trainer that wraps it for that trainer: :mod:`agilerl <.agilerl>`,
  :mod:`benchmarl <.benchmarl>`, :mod:`rllib <.rllib>`, :mod:`sb3 <.sb3>`, :mod:`skrl <.skrl>`,
  :mod:`tianshou <.tianshou>`, :mod:`torchrl <.torchrl>`. Each imports its trainer, which has to be
  installed; nothing else does.
"""
