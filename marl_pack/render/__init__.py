"""Pictures of a bin."""
