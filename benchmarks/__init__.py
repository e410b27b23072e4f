"""Measurements of what is promised; `python -m benchmarks.NAME` prints one."""

# Importing instant_avatar sets the commands' environment before numpy and torch are there:
# threads of BLAS that spin while they wait cost five times as much as the work, on a busy machine.
import instant_avatar  # noqa: F401
