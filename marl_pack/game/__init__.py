"""The packing game: its options, its state, its moves and the rules of a turn."""
