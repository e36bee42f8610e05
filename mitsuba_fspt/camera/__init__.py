"""The camera: numbers of lens and film, and the lines of sight between them; needs no plugin and no scene."""
