"""Learning of the agents: PPO, behaviour cloning, symmetries, the runner and checkpoints."""
