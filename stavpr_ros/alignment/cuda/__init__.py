"""Kernels for CUDA devices, compiled by numba: the twins of those for the CPU."""
