"""Kernels for the CPU, compiled by numba: twins of the torch reference."""
