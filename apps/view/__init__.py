"""A page on this machine alone, on which somebody watches the avatar learn (`ia-ingest --view`)."""
