"""A training run: assembled from its settings, its folder, and its progress on the terminal."""
