"""The studio: a dressed synthetic person, filmed into a capture folder with exact truth."""
