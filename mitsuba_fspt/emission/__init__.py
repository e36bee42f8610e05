"""Emission of a surface: J_n on its elements, and exit laws that distribute it over directions."""
