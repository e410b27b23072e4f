"""Kernels: the operations of a training step, compiled for the CPU."""
