"""Live sources: cameras, growing folders, recordings played in real time."""
