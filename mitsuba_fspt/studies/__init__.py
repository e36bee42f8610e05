"""Studies of many renderings: error against run time, sweeps, and the shortcuts of the integral."""
