"""The networks of the agents: input planes, trunk, heads and masked actions."""
