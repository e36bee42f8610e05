"""Many renderings for one answer: error against run time, sweeps, and what the integral leaves out."""
