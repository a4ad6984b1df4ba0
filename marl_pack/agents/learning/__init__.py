"""How the agents learn: PPO for both, behaviour cloning, symmetries, runs and checkpoints."""
