"""What every program that plays games and measures packings shares.

- :mod:`marl_pack.evaluation.rollout` plays policies and gives the plans of their packings;
- :mod:`marl_pack.evaluation.statistics` computes figures of plans.
"""
