"""Lines of sight: Eq. 9 on one of them, what they meet, and checks of the scene that they are traced in."""
