"""Tracking of the person in a video: key points and masks by networks, poses by a fit."""
