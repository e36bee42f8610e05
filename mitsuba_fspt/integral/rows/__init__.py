"""Rows of the transport matrix and of the derivative by J_n, which are linear in J_n."""
