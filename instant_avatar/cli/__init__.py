"""What all commands share: console, exit codes, output paths."""
