"""What users may choose for pictures and films; importing it is fast."""

ENDINGS = (".png", ".gif", ".mp4")
"""Endings of the files of pictures and films."""
COLOURINGS = ("item", "size", "order", "bin", "weight", "margin")
"""What colours can show; boxes of the same size have the same three sides, in any order."""
