"""Adapters that connect the environment to other libraries' trainers; ``examples/`` uses them.

- :mod:`marl_pack.integrations.network`: a small masked actor-critic in plain PyTorch;
- one module for each trainer, which wraps this actor-critic: :mod:`agilerl <.agilerl>`,
  :mod:`benchmarl <.benchmarl>`, :mod:`rllib <.rllib>`, :mod:`sb3 <.sb3>`, :mod:`skrl <.skrl>`,
  :mod:`tianshou <.tianshou>`, :mod:`torchrl <.torchrl>`. Each of these modules imports its trainer,
  which has to be installed. No other module does.
"""
