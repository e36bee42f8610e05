"""The live view of a scene: a page in the browser or a notebook, and the code that answers its requests."""
