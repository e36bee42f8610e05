"""Triangle surfaces with a surface flux density J_n, and readers for the files of other programs."""
