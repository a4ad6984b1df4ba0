"""Generators of bad and of hard input; ``make fuzz`` runs them for long."""
