"""Light inside the tissue: the diffusion equation by finite elements, from a source to J_n on the surface."""
