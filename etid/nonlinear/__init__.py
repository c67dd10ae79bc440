"""One load, recorded at several amplitudes, whose resistance may fall with its current."""
