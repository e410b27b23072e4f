"""Avatar: learns one person from observations while they arrive."""
