"""Solving cameras in a process of its own, which can be stopped, watched and taken up again."""
