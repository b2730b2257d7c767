"""Compiled kernels of the builder: numba functions over flat arrays."""
