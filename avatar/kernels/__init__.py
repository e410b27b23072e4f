"""Kernels: the protocol of a backend, and the torch reference."""
