"""What a placement leaves behind, and its value."""
