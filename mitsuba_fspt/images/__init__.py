"""Images of power on pixels: the class, its files, comparison, PNG pictures, exposures."""
