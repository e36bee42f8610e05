"""Rows of the transport matrix and of the derivative by J_n (Eq. M.20): the power is linear in J_n."""
