"""The detector: power on pixels to electrons and counts, and counts of a camera to power with its error."""
