"""What every command needs: its voice, its exit codes, Ctrl-C, files written whole, threads."""
