"""The canonical radiance field, its occupancy grid and regularizers."""
