"""Backgrounds of the studio: painted backdrops and a furnished room."""
