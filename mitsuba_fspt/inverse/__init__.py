"""Inverse methods: the transport matrix from J_n to the pixels of several views."""
