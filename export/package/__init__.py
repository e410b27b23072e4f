"""The package: tables, settings, manifest and file."""
