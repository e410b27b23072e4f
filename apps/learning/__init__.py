"""The walk of ia-ingest: from a recording to a trained avatar, and what it leaves on disk."""
