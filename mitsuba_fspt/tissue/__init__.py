"""Light in tissue: the diffusion equation by finite elements, from sources to J_n on the surface."""
