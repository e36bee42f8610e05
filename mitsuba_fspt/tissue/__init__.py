"""Light in tissue: SP3 and diffusion by finite elements, from sources to J_n on the surface."""
