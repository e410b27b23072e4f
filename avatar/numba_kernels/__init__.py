"""Kernels for the CPU, compiled by numba, which agree with the torch reference."""
