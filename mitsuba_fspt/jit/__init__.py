"""Dr.Jit helpers without camera physics: pixel grids, batches, loops, spectra, recording, meshes."""
