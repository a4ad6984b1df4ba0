"""The packer: boxes in, poses out, in millimetres."""
