"""What other people's trainers need to train on the environment; ``examples/`` shows how.

- :mod:`marl_pack.integrations.network`: a small masked actor-critic in plain PyTorch;
- :mod:`marl_pack.integrations.session`: the command line of the examples, and the account of what
  a trainer did with the environment.
"""
