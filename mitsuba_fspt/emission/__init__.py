"""What leaves a surface: J_n on its elements and the exit laws that share it out over directions."""
