"""Helpers of Dr.Jit code that know nothing of cameras: pixel grids, batches, loops, spectra, recording, meshes."""
