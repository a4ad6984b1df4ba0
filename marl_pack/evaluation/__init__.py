"""Play policies and measure their packings, for all programs that do so.

- :mod:`marl_pack.evaluation.rollout` plays policies and returns the plans of their packings;
- :mod:`marl_pack.evaluation.statistics` computes figures of plans.
"""
