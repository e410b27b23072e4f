"""How good an avatar is, as a table: on held-out frames, on another capture, or on the paper's."""
