"""Shared by all commands: console, exit codes, output paths."""
