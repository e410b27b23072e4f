"""An avatar in motion: which poses, seen from where, drawn how fast, and what is made of it."""
