"""The surface form of Eq. 9: elements of surface projected onto the film, for images and for columns of T."""
