"""Eq. 9: the integrand on one line of sight, and its integral in the pupil form and in the surface form."""
