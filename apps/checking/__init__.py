"""A capture examined: what is odd, what would mend it, and the mended copy."""
