"""What it costs and what it gives: each benchmark prints one table, none has thresholds."""

import apps  # the environment in which commands run: threads that wait do not spin

__all__ = ["apps"]
