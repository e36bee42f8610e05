"""The laws of optics as plain numbers: thin lens and its models, media, the boundary of tissue, simple shapes."""
