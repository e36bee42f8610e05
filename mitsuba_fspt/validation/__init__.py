"""Independent references: the integral in float64 NumPy, stiff cases, and the paper's own sum over surface points."""
