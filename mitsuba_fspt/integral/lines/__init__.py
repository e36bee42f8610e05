"""Lines of sight: Eq. 9 on a single one, the surfaces that it meets, and checks of the scene in which it is traced."""
