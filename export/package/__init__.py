"""The package: tables, manifest and file."""
