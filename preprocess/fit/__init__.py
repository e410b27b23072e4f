"""The body that is really used: poses brought to it, in size, place and stance."""
