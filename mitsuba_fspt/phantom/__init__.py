"""Surfaces with a surface flux density J_n, and the files of other programs that they come from."""
