"""The pupil form of Eq. 9: lines of sight through pixel and pupil, more of them where the error asks for it."""
