"""All that is known about a video before its first frame is read."""
