"""Kernels for the CPU, compiled by numba: arithmetic only, arrays are trusted."""
