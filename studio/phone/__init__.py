"""Captures as a phone, a tracker and a segmenter give them: everything a little wrong."""
