"""Pictures of a bin and its boxes."""
