"""The doctor: where poses, masks and cameras disagree, what the mistake is, and how to mend it."""
