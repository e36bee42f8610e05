"""Float64 references in NumPy, independent of the package: Eq. 9 sampled, by fans, along rows and over meshes."""
