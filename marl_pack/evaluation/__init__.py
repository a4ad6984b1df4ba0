"""Play policies and measure their packings.

- :mod:`marl_pack.evaluation.rollout` plays policies and returns the plans of their packings;
- :mod:`marl_pack.evaluation.statistics` computes statistics of plans.
"""
