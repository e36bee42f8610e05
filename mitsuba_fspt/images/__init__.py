"""Images of power on pixels: the class, its files, comparison, pictures to look at, and the detector."""
