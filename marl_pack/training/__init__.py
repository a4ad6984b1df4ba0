"""A training run: its assembly from settings, its folder and its display on the terminal."""
