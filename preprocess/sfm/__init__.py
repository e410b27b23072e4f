"""Structure from motion: solve the cameras of a moving phone."""
