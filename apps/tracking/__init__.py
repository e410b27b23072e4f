"""Tracking of the person in a video, for ia-track and ia-ingest."""
